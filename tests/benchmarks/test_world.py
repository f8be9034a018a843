"""The speed of the world on one core: dynamics, proximity graph, observation, reward and mix.

The flocks are in the steady state of a trained policy, which chose their actions beforehand.
"""

import numpy as np
import pytest

from sb3_flock import Scenario, World, load_policy
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.sim import episode_rng, mix_rewards, observe, own_reward, reward_terms, sensing
from sb3_flock.sim.backend import compiled
from tests.benchmarks.conftest import POLICY

STEADY_STATE, STEPS = 120, 40
"""Steps before the measurement, and steps measured."""


def advance(world, actions):
    """One whole vehicle-step for every vehicle."""
    scenario = world.scenario
    sensed, clipped = world.step(actions)
    observe(sensed, scenario)
    rewards = own_reward(reward_terms(sensed, clipped, scenario.reward, scenario))
    mix_rewards(rewards, sensed.neighbors.observers, sensed.neighbors.vehicles, scenario.reward.lambda_)


def without_numba(monkeypatch):
    for module in ("sensing", "observation", "reward", "world"):
        monkeypatch.setattr(f"sb3_flock.sim.{module}.compiled", lambda: None)


@pytest.mark.parametrize("kind", ["numba", "numpy"])
@pytest.mark.parametrize("n_flocks", [1, 64, 1024])
def test_vehicle_steps(benchmark, peer_of_world, monkeypatch, n_flocks, kind):
    if kind == "numpy":
        without_numba(monkeypatch)
    elif compiled() is None:
        pytest.skip("numba is not installed")
    policy = load_policy(POLICY)
    controller, world = PolicyController(policy), World(policy.scenario, n_flocks)
    sensed = world.reset([episode_rng(0, episode) for episode in range(n_flocks)])
    for _ in range(STEADY_STATE):
        sensed, _ = world.step(controller.act(sensed, policy.scenario))
    start, actions = dict(vars(world)), []
    for _ in range(STEPS):
        actions.append(controller.act(sensed, policy.scenario))
        sensed, _ = world.step(actions[-1])

    def run():
        vars(world).update(start)
        for action in actions:
            advance(world, action)

    benchmark.pedantic(run, rounds=15, warmup_rounds=2)
    if benchmark.disabled:
        return
    vehicle_steps = n_flocks * policy.scenario.n_vehicles * STEPS
    speed = vehicle_steps / benchmark.stats.stats.median
    benchmark.extra_info |= {
        "vehicle_steps_per_second": speed,
        "neighbors": float(sensed.neighbors.count().mean()),
        "bytes_of_observation_per_vehicle_step": int(np.prod(policy.scenario.observation_shape))
        * np.dtype(np.float32).itemsize,
    }
    peer_of_world(benchmark, speed, "vmas", n_flocks, 5, 2)


def crowd(n_vehicles):
    """One world of constant density: four neighbors within range on average, an obstacle for ten vehicles."""
    side = np.sqrt(n_vehicles * np.pi * Scenario().link_range ** 2 / 4)
    return World(
        Scenario(
            n_vehicles=n_vehicles, n_obstacles=n_vehicles // 10, arena=side / 2, neighbor_separation=0.0,
            obstacle_separation=0.0, max_cycles=200,
        )
    )  # fmt: skip


@pytest.mark.parametrize("n_vehicles", [10, 100, 1_000, 10_000, 100_000])
def test_seconds_per_step_of_one_crowd(benchmark, peer_of_world, n_vehicles):
    world = crowd(n_vehicles)
    sensed = world.reset([episode_rng(0, 0)])
    rng = np.random.default_rng(0)
    actions = rng.uniform(world.action_low, world.action_high, (1, n_vehicles, 2))
    benchmark.pedantic(advance, (world, actions), rounds=20, warmup_rounds=3)
    if benchmark.disabled:
        return
    seconds = benchmark.stats.stats.median
    benchmark.extra_info |= {
        "seconds_per_step": seconds,
        "neighbors": float(sensed.neighbors.count().mean()),
        "microseconds_per_vehicle": 1e6 * seconds / n_vehicles,
    }
    if n_vehicles <= 100:  # VMAS needs more than four minutes to measure 1000
        for name in ("vmas", "mpe2"):
            peer_of_world(benchmark, n_vehicles / seconds, name, 1, n_vehicles, n_vehicles // 10)


@pytest.mark.parametrize("n_vehicles", [1_000, 10_000])
def test_seconds_per_step_of_one_crowd_and_its_policy(benchmark, n_vehicles):
    """The world of a crowd and the policy that drives it."""
    world, controller = crowd(n_vehicles), PolicyController(load_policy(POLICY))
    start = world.reset([episode_rng(0, 0)])

    def step(sensed):
        return world.step(controller.act(sensed[-1], world.scenario))[:1]

    benchmark.pedantic(step, ([start],), rounds=15, warmup_rounds=2)
    if not benchmark.disabled:
        benchmark.extra_info["seconds_per_step"] = benchmark.stats.stats.median


@pytest.fixture
def peer_of_world(request):
    """A function that measures a peer on the same numbers of flocks, vehicles and obstacles and records the result."""

    def compare(benchmark, speed, name, flocks, vehicles, obstacles):
        try:
            measure = request.getfixturevalue("peer")
        except pytest.skip.Exception:
            return  # this package alone
        size = ("--flocks", flocks, "--obstacles", obstacles) if name == "vmas" else ()  # MPE2 has one world, no obstacles
        result = measure("worlds.py", name, "--vehicles", vehicles, *size, "--seconds", 3)
        benchmark.extra_info[name] = result
        benchmark.extra_info[f"times_{name}"] = speed / result["vehicle_steps_per_second"]

    return compare


def test_the_numpy_path_is_measured_without_numba(monkeypatch):
    without_numba(monkeypatch)
    assert sensing.compiled() is None
