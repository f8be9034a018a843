"""Numbers stay within their bounds over random scenarios and actions; ``pytest -m slow`` takes ten million vehicle-steps."""

import gc
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_flock.envs.flocking_v0 import observation_space
from sb3_flock.sim import RewardWeights, Scenario, World, episode_rng, mix_rewards, observe, own_reward, reward_terms
from sb3_flock.sim.sensors import SensorErrors
from sb3_flock.sim.world import WorldError


def random_scenario(rng):
    """A scenario of any size, from centimeters to kilometers."""
    time_step = 10 ** rng.uniform(-3, 1)
    unit = 10 ** rng.uniform(-2, 3)
    link, detection = unit * rng.uniform(0.05, 2, 2)
    return Scenario(
        n_vehicles=int(rng.integers(1, 30)),
        n_obstacles=int(rng.integers(0, 10)),
        max_cycles=int(rng.integers(1, 60)),
        time_step=time_step,
        motion_lag=time_step * int(rng.integers(0, 4)),
        max_speed=unit * 10 ** rng.uniform(-3, 1),
        max_turn_rate=10 ** rng.uniform(-2, 2),
        obstacle_max_speed=unit * rng.uniform(0, 1),
        obstacle_turn_std=rng.uniform(0, 20),
        obstacle_motion=str(rng.choice(["walk", "crossing"])),
        waypoint_speed=unit * rng.uniform(0, 1),
        waypoint_route=None if rng.random() < 0.7 else (unit * rng.normal(size=(int(rng.integers(1, 5)), 2))).tolist(),
        sensors=SensorErrors()
        if rng.random() < 0.7
        else SensorErrors(position_noise=unit * rng.random(), dropout=rng.random()),
        arena=unit * rng.uniform(0.5, 5),
        link_range=link,
        neighbor_separation=link * rng.uniform(0, 0.9),
        detection_range=detection,
        obstacle_separation=detection * rng.uniform(0, 0.9),
        n_anchors=int(rng.integers(2, 20)),
        goal_radius=unit * rng.uniform(0.1, 3),
        anchor_width=rng.uniform(0.1, 3),
        reward=RewardWeights(
            epsilon=10 ** rng.uniform(-3, 2),
            max_distance=unit * rng.uniform(0.1, 3) if rng.random() < 0.5 else None,
            beta=-(10 ** rng.uniform(-3, 1)),
            lambda_=rng.uniform(0, 1),
        ),
    )


def soak(vehicle_steps, seed):
    """Simulate random actions, some far out of bounds, and check every number."""
    rng = np.random.default_rng(seed)
    simulated = 0
    while simulated < vehicle_steps:
        scenario = random_scenario(rng)
        n, m, weights = scenario.n_vehicles, scenario.n_obstacles, scenario.reward
        n_flocks = max(1, 6000 // n)
        world = World(scenario, n_flocks)
        try:
            world.reset([episode_rng(seed, int(episode)) for episode in rng.integers(0, 2**31, n_flocks)])
        except WorldError:
            continue
        space = observation_space(scenario)
        for _ in range(scenario.max_cycles):
            actions = rng.normal(size=(n_flocks, n, 2)) * (3 * scenario.max_speed, 3 * scenario.max_turn_rate)
            before = world.positions
            sensing, clipped = world.step(actions)
            distances = np.linalg.norm(world.positions - before, axis=-1)
            longest = scenario.max_speed * scenario.time_step
            assert (distances <= longest + 1e-12 * (longest + np.abs(world.positions).max())).all()
            assert (np.abs(world.headings) <= np.pi).all()
            assert (np.abs(world.obstacle_positions) <= scenario.obstacle_half_side * (1 + 1e-12)).all() or m == 0
            observations = observe(world.sensors.measure(sensing), scenario)
            assert observations.dtype == np.float32
            assert observations.min() >= space.low.min()  # a NaN fails here, too
            assert observations.max() <= n + m + 1
            terms = reward_terms(sensing, clipped, scenario.reward, scenario)
            farthest = np.sqrt(8) * (np.abs(world.positions).max() + scenario.arena + np.abs(world.waypoints).max())
            farthest = min(farthest, weights.max_distance or np.inf)
            effort = scenario.max_speed**2 + scenario.max_turn_rate**2
            bounds = {
                "connectivity": (-weights.separation_penalty * (n - 1), weights.link_bonus * (n - 1)),
                "obstacle": (-weights.obstacle_penalty * m, 0),
                "waypoint": (-weights.epsilon * farthest, 0),
                "control": (weights.beta * effort, 0),
            }
            assert terms.keys() == bounds.keys()
            for name, (low, high) in bounds.items():
                slack = 1e-9 * weights.scale * (abs(low) + abs(high))
                assert terms[name].min() >= weights.scale * low - slack, name
                assert terms[name].max() <= weights.scale * high + slack, name
            own = own_reward(terms).reshape(-1)
            observers, bodies = sensing.neighbors.observers, sensing.neighbors.bodies
            mixed = mix_rewards(own, observers, observers - observers % n + bodies, weights.lambda_)
            assert mixed.min() >= own.min() - 1e-9 * np.abs(own).max()
            assert mixed.max() <= own.max() + 1e-9 * np.abs(own).max()
            simulated += n_flocks * n
    return simulated


def memory():
    """Resident memory [MB]."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def test_a_short_soak():
    soak(200_000, seed=0)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_ten_million_vehicle_steps_with_flat_memory():
    soak(1_000_000, seed=0)
    before = memory()
    for seed in range(1, 10):
        soak(1_000_000, seed)
    assert memory() - before < 50
