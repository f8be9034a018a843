"""The reward of section IV-B: four terms by name, their sum, and the neighbor-inclusive mix."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.scenario import Scenario
    from sb3_flock.sim.sensing import Sensing


class RewardWeights(Settings):
    """The weights of the reward. Those the paper does not name are 1, its plain sum, in ``configs/paper_plain.yaml``."""

    link_bonus: NotNegative = Field(0.5, description="reward for each neighbor at a safe distance (paper, IV-B: 1)")
    separation_penalty: NotNegative = Field(
        6.0, description="penalty for each neighbor nearer than neighbor_separation (paper, IV-B: 1)"
    )
    obstacle_penalty: NotNegative = Field(
        12.0, description="penalty for each obstacle nearer than obstacle_separation (paper, IV-B: 1)"
    )
    epsilon: NotNegative = Field(10.0, description="weight of the distance to the waypoint [1/m] (paper leaves it open)")
    max_distance: Positive | None = Field(
        None, description="distance to the waypoint beyond which it costs no more [m]; null: none (ours; paper: none)"
    )
    beta: float = Field(
        -0.02, ge=-1e6, le=0, description="weight of the squared action [m/s, rad/s], not positive (paper leaves it open)"
    )
    lambda_: float = Field(
        0.7, ge=0, le=1, description="share of a vehicle's own reward in the mix with its neighbors' (open)"
    )
    scale: Positive = Field(0.02, description="factor on the sum of the four terms (ours; paper: 1)")


def reward_terms(sensing: Sensing, actions: NDArray[np.float64], scenario: Scenario) -> dict[str, NDArray[np.float64]]:
    """The four terms of r_i, weighted and scaled, so that their sum is r_i.

    :param sensing: what every vehicle senses after the step
    :param actions: ``(flocks, vehicles, 2)`` [m/s, rad/s], the clipped actions that led there
    :param scenario: ranges and weights
    :return: ``connectivity``, ``obstacle``, ``waypoint`` and ``control``, each ``(flocks, vehicles)``
    """
    weights = scenario.reward
    distances = np.minimum(sensing.waypoint_distances, np.inf if weights.max_distance is None else weights.max_distance)
    too_close = sensing.neighbors.count(scenario.neighbor_separation)
    linked = sensing.neighbors.count() - too_close
    terms = {
        "connectivity": weights.link_bonus * linked - weights.separation_penalty * too_close,
        "obstacle": -weights.obstacle_penalty * sensing.obstacles.count(scenario.obstacle_separation),
        "waypoint": -weights.epsilon * distances,
        "control": weights.beta * (np.square(actions[..., 0]) + np.square(actions[..., 1])),
    }
    return {name: weights.scale * term for name, term in terms.items()}


def own_reward(terms: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """r_i, the sum of its terms (section IV-B)."""
    return functools.reduce(np.add, terms.values())


def mix_rewards(
    rewards: NDArray[np.floating], observers: NDArray[np.int64], neighbors: NDArray[np.int64], lambda_: float
) -> NDArray[np.float64]:
    """The neighbor-inclusive reward r_{i} = lambda r_i + (1 - lambda) mean of the neighbors' r_j (section IV-B).

    A vehicle without neighbors keeps its own r_i, unscaled: scaling it would pay (or fine) it for being alone.

    :param rewards: r of all vehicles, of any shape
    :param observers: ``(links,)``, number i of a vehicle in ``rewards``, flattened
    :param neighbors: ``(links,)``, number j of one of its neighbors
    :param lambda_: share of the own reward, in [0, 1]
    :return: the shape of ``rewards``
    """
    own = np.asarray(rewards, dtype=np.float64).ravel()
    count = np.bincount(observers, minlength=len(own))
    others = np.bincount(observers, own[neighbors], minlength=len(own)) / np.maximum(count, 1)
    return np.where(count > 0, lambda_ * own + (1 - lambda_) * others, own).reshape(np.shape(rewards))
