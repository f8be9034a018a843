"""The reward of section IV-B: named terms, their sum, and the neighbor-inclusive mix.

A further term is a function registered with :func:`register_reward_term`; ``RewardWeights(extra_terms={"name": weight})``
switches it on.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, field_validator

from sb3_flock.settings import NotNegative, Positive, Settings, suggest
from sb3_flock.sim.backend import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.sensing import Sensing, SensingSettings

    RewardTerm = Callable[[Sensing, NDArray[np.float64], SensingSettings], NDArray[np.float64]]

EXTRA_TERMS: dict[str, RewardTerm] = {}
"""Registered further terms by name."""

_OWN_TERMS = ("connectivity", "obstacle", "waypoint", "control")


def register_reward_term(name: str) -> Callable[[RewardTerm], RewardTerm]:
    """Register a further reward term under a name, as a decorator.

    The function gets what every vehicle senses after the step, the executed actions ``(flocks, vehicles, 2)`` [m/s, rad/s] and
    the sensing ranges. It returns the unweighted term, ``(flocks, vehicles)``.

    :raises ValueError: if a term has the name already
    """

    def register(term: RewardTerm) -> RewardTerm:
        if name in _OWN_TERMS or EXTRA_TERMS.setdefault(name, term) is not term:
            raise ValueError(f"reward term {name!r} is registered already")
        return term

    return register


class RewardWeights(Settings):
    """The weights of the reward. The paper's plain sum is in ``configs/paper_plain.yaml``: weights of 1."""

    link_bonus: NotNegative = Field(1.5, description="reward for each neighbor at a safe distance (paper: 1)")
    separation_penalty: NotNegative = Field(
        6.0, description="penalty for each neighbor nearer than neighbor_separation (paper: 1)"
    )
    obstacle_penalty: NotNegative = Field(
        12.0, description="penalty for each obstacle nearer than obstacle_separation (paper: 1)"
    )
    epsilon: NotNegative = Field(10.0, description="weight of the distance to the waypoint [1/m] (paper: not stated)")
    max_distance: Positive | None = Field(
        None, description="distance to the waypoint at which its penalty saturates [m]; null: never (paper: null)"
    )
    beta: float = Field(
        -0.02, ge=-1e6, le=0, description="weight of the squared action [m/s, rad/s], not positive (paper: not stated)"
    )
    lambda_: float = Field(
        0.4, ge=0, le=1, description="share of a vehicle's own reward in the mix with its neighbors' (paper: not stated)"
    )
    scale: Positive = Field(0.02, description="factor on the sum of the terms (paper: 1)")
    extra_terms: dict[str, float] = Field({}, description="weights of further registered terms by name (paper: none)")

    @field_validator("extra_terms")
    @classmethod
    def _are_registered(cls, weights: dict[str, float]) -> dict[str, float]:
        for name in weights:
            if name not in EXTRA_TERMS:
                known = f"registered are {', '.join(EXTRA_TERMS)}" if EXTRA_TERMS else "none is registered"
                raise ValueError(
                    f"extra_terms = {name}: a term registered with register_reward_term is needed; "
                    f"{known}{suggest(name, EXTRA_TERMS)}"
                )
        return weights

    def __hash__(self) -> int:
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return hash((frozenset(values.pop("extra_terms").items()), *values.values()))


def reward_terms(
    sensing: Sensing, actions: NDArray[np.float64], weights: RewardWeights, ranges: SensingSettings
) -> dict[str, NDArray[np.float64]]:
    """The terms of r_i, weighted and scaled, so that their sum is r_i (section IV-B).

    :param sensing: what every vehicle senses after the step
    :param actions: ``(flocks, vehicles, 2)`` [m/s, rad/s], the executed actions of the step
    :param weights: the weights
    :param ranges: the sensing ranges and minimum separations
    :return: ``connectivity``, ``obstacle``, ``waypoint``, ``control`` and the extra terms, each ``(flocks, vehicles)``
    """
    kernels = compiled()
    compute = own_terms if kernels is None else kernels.own_terms
    own = compute(
        sensing.neighbors.observers,
        sensing.neighbors.distances,
        sensing.obstacles.observers,
        sensing.obstacles.distances,
        sensing.waypoint_distances,
        actions,
        (ranges.neighbor_separation, ranges.obstacle_separation),
        (weights.link_bonus, weights.separation_penalty, weights.obstacle_penalty, weights.epsilon, weights.beta),
        np.inf if weights.max_distance is None else weights.max_distance,
        weights.scale,
    )
    terms = dict(zip(_OWN_TERMS, own, strict=True))
    for name, weight in weights.extra_terms.items():
        terms[name] = weights.scale * (weight * EXTRA_TERMS[name](sensing, actions, ranges))
    return terms


def own_terms(
    neighbor_observers: NDArray[np.int64],
    neighbor_distances: NDArray[np.float64],
    obstacle_observers: NDArray[np.int64],
    obstacle_distances: NDArray[np.float64],
    waypoint_distances: NDArray[np.float64],
    actions: NDArray[np.float64],
    separations: tuple[float, float],
    weights: tuple[float, float, float, float, float],
    max_distance: float,
    scale: float,
) -> NDArray[np.float64]:
    """The paper's terms in the order of ``connectivity``, ``obstacle``, ``waypoint``, ``control`` (section IV-B).

    :param neighbor_observers: :attr:`~sb3_flock.sim.sensing.Contacts.observers` of the neighbors, and so on
    :param waypoint_distances: ``(flocks, vehicles)`` [m]
    :param actions: ``(flocks, vehicles, 2)`` [m/s, rad/s]
    :param separations: minimum separations to neighbors and to obstacles [m]
    :param weights: ``link_bonus``, ``separation_penalty``, ``obstacle_penalty``, ``epsilon`` and ``beta``
    :return: ``(4, flocks, vehicles)``
    """

    def count(observers: NDArray[np.int64]) -> NDArray[np.int64]:
        counts: NDArray[np.int64] = np.bincount(observers, minlength=waypoint_distances.size)
        return counts.reshape(waypoint_distances.shape)

    link_bonus, separation_penalty, obstacle_penalty, epsilon, beta = weights
    violations = count(neighbor_observers[neighbor_distances < separations[0]])
    linked = count(neighbor_observers) - violations
    return scale * np.stack(
        (
            link_bonus * linked - separation_penalty * violations,
            -obstacle_penalty * count(obstacle_observers[obstacle_distances < separations[1]]),
            -epsilon * np.minimum(waypoint_distances, max_distance),
            beta * (np.square(actions[..., 0]) + np.square(actions[..., 1])),
        )
    )


def own_reward(terms: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """r_i, the sum of its terms (section IV-B)."""
    return functools.reduce(np.add, terms.values())


def mix_rewards(
    rewards: NDArray[np.floating], observers: NDArray[np.int64], neighbors: NDArray[np.int64], lambda_: float
) -> NDArray[np.float64]:
    """The neighbor-inclusive reward r_{i} = lambda r_i + (1 - lambda) mean of the neighbors' r_j (section IV-B).

    A vehicle without neighbors keeps its own r_i, unscaled: a scaled one would reward or punish the vehicle for being alone.

    :param rewards: r of all vehicles, of any shape
    :param observers: ``(links,)``, number i of a vehicle in ``rewards``, flattened
    :param neighbors: ``(links,)``, number j of one of its neighbors
    :param lambda_: share of the own reward, in [0, 1]
    :return: the shape of ``rewards``
    :raises IndexError: for a number that is not a vehicle's
    """
    own = np.asarray(rewards, dtype=np.float64).ravel()
    kernels = compiled()
    if kernels is not None:
        return kernels.mix_rewards(own, observers, neighbors, lambda_).reshape(np.shape(rewards))
    if len(neighbors) and min(observers.min(), neighbors.min()) < 0:
        raise IndexError("observers and neighbors are numbers of vehicles, from 0")
    count = np.bincount(observers, minlength=len(own))
    mean_of_neighbors = np.bincount(observers, own[neighbors], minlength=len(own)) / np.maximum(count, 1)
    return np.where(count > 0, lambda_ * own + (1 - lambda_) * mean_of_neighbors, own).reshape(np.shape(rewards))
