"""Simulating many episodes at once with any controller, and evaluating them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock._renamed import warn_renamed
from sb3_flock.controllers import Controller
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.evaluation.metrics import EpisodeMetric, EpisodeMetrics, Metric, find_metrics, summarize
from sb3_flock.settings import SettingsError, check_integer
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, own_reward, reward_terms

BATCH = 250
"""Episodes simulated at once; it bounds the memory and does not change the results."""


def rollout(
    policy: Any,
    scenario: Scenario,
    episodes: int,
    seed: int,
    batch: int = BATCH,
    watch: Callable[[World], None] = lambda world: None,
    metrics: Sequence[type[EpisodeMetric]] | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Simulate episodes 0 ... ``episodes - 1`` of a seed.

    :param policy: as in :func:`evaluate`
    :param batch: episodes simulated at once; it does not change the results
    :param watch: called with the world of the first batch at the start and after each step
    :param metrics: what is measured; every registered metric by default
    :return: each metric's value for each episode, ``(episodes,)``
    :raises SettingsError: for counts that are not accepted
    """
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0), ("batch", batch, 1)):
        check_integer(name, value, least)
    controller = as_controller(policy, scenario)
    results = []
    for start in range(0, episodes, batch):
        rngs = [episode_rng(seed, episode) for episode in range(start, min(start + batch, episodes))]
        results.append(
            rollout_batch(lambda world: controller, scenario, rngs, **({} if start else {"watch": watch}), metrics=metrics)
        )
    return {name: np.concatenate([result[name] for result in results]) for name in results[0]}


def rollout_batch(
    make_controller: Callable[[World], Controller],
    scenario: Scenario,
    rngs: Sequence[np.random.Generator],
    watch: Callable[[World], None] = lambda world: None,
    metrics: Sequence[type[EpisodeMetric]] | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Simulate a batch of episodes in lockstep.

    :param make_controller: makes the controller of a world; a privileged one may read the whole world
    :param rngs: one generator per episode
    :param watch: called with the world at the start and after each step
    :param metrics: what is measured; every registered metric by default
    :return: each metric's value for each episode, ``(episodes,)``
    """
    measured = EpisodeMetrics(scenario, len(rngs), metrics)
    world, sensing, controller = _start(make_controller, scenario, rngs)
    watch(world)
    for _ in range(scenario.max_cycles):
        sensing, executed = world.step(controller.act(world.sensors.measure(sensing), scenario))
        measured.update(world, sensing, own_reward(reward_terms(sensing, executed, scenario.reward, scenario)))
        watch(world)
    return measured.result()


def iter_rollout(policy: Any, scenario: Scenario, seed: int = 0, episode: int = 0) -> Iterator[World]:
    """Simulate one episode, the same as :func:`rollout` does under this number.

    :param policy: as in :func:`evaluate`
    :return: the world at the start and after each step, always the same object
    """
    check_integer("seed", seed, 0)
    check_integer("episode", episode, 0)
    controller = as_controller(policy, scenario)
    world, sensing, _ = _start(lambda world: controller, scenario, [episode_rng(seed, episode)])
    yield world
    for _ in range(scenario.max_cycles):
        sensing, _ = world.step(controller.act(world.sensors.measure(sensing), scenario))
        yield world


def _start(
    make_controller: Callable[[World], Controller], scenario: Scenario, rngs: Sequence[np.random.Generator]
) -> tuple[World, Sensing, Controller]:
    """A world at the start of its episodes, what is sensed there, and its controller, reset."""
    world = World(scenario, len(rngs))
    sensing, controller = world.reset(rngs), make_controller(world)
    controller.reset(rngs, scenario)
    return world, sensing, controller


def as_controller(policy: Any, scenario: Scenario) -> Controller:
    """A controller or anything with SB3's ``predict`` as a :class:`Controller`; a loaded policy is checked against the scenario.

    :raises PolicyError: if a loaded policy's observations differ in shape; it warns where they have another meaning
    """
    if isinstance(policy, Controller):
        return policy
    from sb3_flock.serialization.load import LoadedPolicy  # imports torch, which no other controller needs

    if isinstance(policy, LoadedPolicy):
        policy.check(scenario)
    if callable(getattr(policy, "act", None)):  # accepted without the base class by the previous release
        warn_renamed(f"{type(policy).__name__} without a base class", "to be a subclass of Controller")
        return _Adapter(policy)
    if not callable(getattr(policy, "predict", None)):
        raise SettingsError(f"policy = {type(policy).__name__}: a Controller, or an object with SB3's predict, is needed")
    return PolicyController(policy)


class _Adapter(Controller):
    """A controller of the previous release, which needed no base class."""

    def __init__(self, controller: Any) -> None:
        self.controller = controller

    def reset(self, rngs: Sequence[np.random.Generator], scenario: Scenario) -> None:
        getattr(self.controller, "reset", super().reset)(rngs, scenario)

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        actions: NDArray[np.floating] = self.controller.act(sensing, scenario)
        return actions


def evaluate(
    policy: Any,
    scenario: Scenario | None = None,
    episodes: int = 1000,
    seed: int = 0,
    batch: int = BATCH,
    metrics: Sequence[str | type[EpisodeMetric]] | None = None,
) -> dict[str, Metric]:
    """Evaluate a policy or any other controller.

    It warns where the scenario has a safety filter that guarantees nothing, and names what ends the guarantee.

    :param policy: a :class:`Controller`, or anything with SB3's ``predict``: a model of any algorithm, recurrent or not, whose
        env ``VecNormalize`` and ``VecFrameStack`` may wrap
    :param scenario: the task; the default is the one a loaded policy was trained for
    :param episodes: number of episodes
    :param seed: episode e draws from ``SeedSequence([seed, e])``
    :param metrics: what is measured, by name or as classes, registered or not; by default every metric of
        :data:`~sb3_flock.evaluation.METRICS`
    :return: the metrics by name
    :raises SettingsError: for counts or metrics that are not accepted, or without a scenario
    :raises PolicyError: if a loaded policy's observations differ in shape; it warns where they have another meaning
    """
    scenario = scenario or getattr(policy, "scenario", None)
    if scenario is None:
        raise SettingsError("scenario = None: the policy carries none, so one is needed")
    if scenario.guarantee_limits:
        warnings.warn(
            f"the safety filter guarantees no separation with {', '.join(scenario.guarantee_limits)}", stacklevel=2
        )
    kinds = find_metrics(metrics)
    values = rollout(policy, scenario, episodes, seed, batch, metrics=kinds)
    return summarize(values, {kind.name: kind for kind in kinds})
