"""Flying many episodes at once with any controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.metrics import EpisodeMetrics, Metric, summarize
from sb3_flock.settings import SettingsError, check_integer
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, observe, own_reward, reward_terms

BATCH = 250
"""Episodes flown at once; it bounds the memory and changes no number."""

_BLOCK = 256
"""Rows a network sees at once, filled up with zeros. Matrix products of another shape may round otherwise; with one shape
only, a vehicle's action does not depend on how many others are computed beside it."""


class Controller(Protocol):
    """Whatever can fly vehicles: a learned policy or a hand-written law.

    One that remembers or draws has a ``reset(rngs, scenario)``, too: episodes begin, one generator a flock.
    """

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        """The actions ``(flocks, vehicles, 2)`` [m/s, rad/s], each from what its own vehicle senses alone."""
        ...


class PolicyController:
    """Flies anything with SB3's ``predict(observations, deterministic=...)``: a model, its policy or a loaded one.

    :param policy: the policy; one row of its input is one vehicle's tensor
    """

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        """Deterministic actions from the tensors."""
        tensors = observe(sensing, scenario)
        rows = tensors.reshape(-1, *scenario.observation_shape)
        padded = np.zeros((-(-len(rows) // _BLOCK) * _BLOCK, *rows.shape[1:]), dtype=rows.dtype)
        padded[: len(rows)] = rows
        actions = [
            self.policy.predict(padded[start : start + _BLOCK], deterministic=True)[0]
            for start in range(0, len(padded), _BLOCK)
        ]
        return np.concatenate(actions)[: len(rows)].reshape(*tensors.shape[:2], 2)


def fly(
    controller: Controller, scenario: Scenario, episodes: int, seed: int, batch: int = BATCH
) -> dict[str, NDArray[np.float64]]:
    """Fly episodes 0 ... ``episodes - 1`` of a seed.

    :param batch: episodes flown at once; it changes no number
    :return: each metric's value for each episode, ``(episodes,)``
    :raises SettingsError: for counts that are not accepted
    """
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0), ("batch", batch, 1)):
        check_integer(name, value, least)
    results = []
    for start in range(0, episodes, batch):
        rngs = [episode_rng(seed, episode) for episode in range(start, min(start + batch, episodes))]
        results.append(fly_together(lambda world: controller, scenario, rngs))
    return {name: np.concatenate([result[name] for result in results]) for name in results[0]}


def fly_together(
    pilot: Callable[[World], Controller], scenario: Scenario, rngs: Sequence[np.random.Generator]
) -> dict[str, NDArray[np.float64]]:
    """Fly episodes in lockstep.

    :param pilot: who flies a world; it may be one who sees all of it
    :param rngs: one generator an episode
    :return: each metric's value for each episode, ``(episodes,)``
    """
    metrics = EpisodeMetrics(scenario, len(rngs))
    world, sensing, controller = _begin(pilot, scenario, rngs)
    for _ in range(scenario.max_cycles):
        sensing, clipped = world.step(controller.act(world.sensors.measure(sensing), scenario))
        metrics.update(world, sensing, own_reward(reward_terms(sensing, clipped, scenario)))
    return metrics.result()


def fly_one(policy: Any, scenario: Scenario, seed: int = 0, episode: int = 0) -> Iterator[World]:
    """Fly one episode, the same that :func:`fly` flies under this number.

    :param policy: as in :func:`evaluate`
    :return: the world at the start and after each step, always the same object
    """
    check_integer("seed", seed, 0)
    check_integer("episode", episode, 0)
    flies = as_controller(policy, scenario)
    world, sensing, controller = _begin(lambda world: flies, scenario, [episode_rng(seed, episode)])
    yield world
    for _ in range(scenario.max_cycles):
        sensing, _ = world.step(controller.act(world.sensors.measure(sensing), scenario))
        yield world


def _begin(
    pilot: Callable[[World], Controller], scenario: Scenario, rngs: Sequence[np.random.Generator]
) -> tuple[World, Sensing, Controller]:
    """A world at the start of its episodes, one a generator, what is sensed there, and who flies, who is told."""
    world = World(scenario, len(rngs))
    sensing, controller = world.reset(rngs), pilot(world)
    if hasattr(controller, "reset"):
        controller.reset(rngs, scenario)
    return world, sensing, controller


def as_controller(policy: Any, scenario: Scenario) -> Controller:
    """Whatever can fly as a :class:`Controller`, checked against the scenario.

    :raises PolicyError: if a loaded policy's tensor has another shape; it warns where the tensor means something else
    """
    if hasattr(policy, "check"):
        policy.check(scenario)
    return policy if hasattr(policy, "act") else PolicyController(policy)


def evaluate(
    policy: Any, scenario: Scenario | None = None, episodes: int = 1000, seed: int = 0, batch: int = BATCH
) -> dict[str, Metric]:
    """Judge a policy or any other controller.

    :param policy: a :class:`Controller`, or anything with SB3's ``predict``
    :param scenario: the task to fly; the default is the one a loaded policy was trained for
    :param episodes: number of episodes
    :param seed: episode e draws from ``SeedSequence([seed, e])``
    :return: every metric of :data:`~sb3_flock.evaluation.METRICS` by name
    :raises SettingsError: for counts that are not accepted, or without a scenario
    :raises PolicyError: if a loaded policy's tensor has another shape; it warns where the tensor means something else
    """
    scenario = scenario or getattr(policy, "scenario", None)
    if scenario is None:
        raise SettingsError("scenario = None: the policy carries none, so one is needed")
    return summarize(fly(as_controller(policy, scenario), scenario, episodes, seed, batch))
