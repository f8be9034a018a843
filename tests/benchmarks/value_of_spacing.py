"""What a critic believes of a tight pack, and what is true: ``python tests/benchmarks/value_of_spacing.py ddpg-5v2o value.png``.

Three vehicles stand around the waypoint, each at the same distance from the other two and facing anywhere. The critics' value of
that is compared with the discounted reward that the same policy then collects in practice: without exploration, and with some.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch as th

from sb3_flock import load_policy
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.serialization.load import LoadedPolicy
from sb3_flock.sim import Scenario, World, episode_rng, observe, own_reward, reward_terms, sense
from sb3_flock.viz.figures import new_figure, save_as

SPACINGS = np.round(np.arange(0.09, 0.1491, 0.003), 3)
FLOCKS = 256
STEPS = 75
"""Of practice: what comes later hardly counts."""
NOISE = 0.1
"""Standard deviation of the exploration [half the action range]."""


def triangles(scenario: Scenario, spacing: float) -> World:
    """Three vehicles in each flock, ``spacing`` apart around the waypoint."""
    rng = np.random.default_rng(0)
    world = World(scenario, FLOCKS)
    world.reset([episode_rng(0, episode) for episode in range(FLOCKS)])
    angles = rng.uniform(-np.pi, np.pi, (FLOCKS, 1)) + 2 * np.pi / 3 * np.arange(3)
    world.positions = spacing / np.sqrt(3) * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    world.headings = rng.uniform(-np.pi, np.pi, (FLOCKS, 3))
    world.waypoints = np.zeros((FLOCKS, 2))
    return world


def believed(policy: LoadedPolicy, world: World) -> float:
    """The smaller critic's mean value, in units of the unscaled reward."""
    tensors = th.as_tensor(observe(sense(world), world.scenario)).flatten(0, 1)
    with th.no_grad():
        values = th.cat(policy.policy.critic(tensors, policy.policy.actor(tensors)), dim=1).amin(1)
    return values.mean().item() / world.scenario.reward.scale


def collected(policy: LoadedPolicy, world: World, noise: float) -> float:
    """The mean discounted reward of the flights that start here, unscaled."""
    controller, scenario, rng = PolicyController(policy), world.scenario, np.random.default_rng(1)
    sensing, total = sense(world), 0.0
    half_range = (world.action_high - world.action_low) / 2
    for step in range(min(STEPS, scenario.max_cycles)):
        actions = controller.act(world.sensors.measure(sensing), scenario)
        sensing, clipped = world.step(actions + noise * half_range * rng.normal(size=actions.shape))
        reward = own_reward(reward_terms(sensing, clipped, scenario)).mean()
        total += policy.config.algorithm.gamma**step * float(reward)
    return total / scenario.reward.scale


def main(name: str, picture: str | None = None) -> None:
    """Print the three values by spacing; draw them, too."""
    th.set_num_threads(1)
    policy = load_policy(name)
    scenario = policy.config.training_scenarios()[0].replace(n_vehicles=3, n_obstacles=0)
    columns = {
        "believed": [believed(policy, triangles(scenario, spacing)) for spacing in SPACINGS],
        "true": [collected(policy, triangles(scenario, spacing), 0.0) for spacing in SPACINGS],
        f"true, with noise {NOISE}": [collected(policy, triangles(scenario, spacing), NOISE) for spacing in SPACINGS],
    }
    print("spacing", *columns, sep="  ")
    for spacing, *values in zip(SPACINGS, *columns.values(), strict=True):
        print(f"{spacing:.3f}", *(f"{value:8.2f}" for value in values))
    if picture:
        figure, axes = new_figure()
        for (label, values), style in zip(columns.items(), ("o-", "s--", "^:"), strict=True):
            axes.plot(SPACINGS, values, style, color="black", markersize=4, label=label)
        axes.axvline(scenario.neighbor_separation, color="gray", linewidth=1)
        axes.set(xlabel="spacing [m] (line: practice's minimum)", ylabel="value [rewards]", title=f"three at rest, {name}")
        axes.grid(alpha=0.3)
        axes.legend()
        save_as(figure, Path(picture), Path(picture).suffix[1:])


if __name__ == "__main__":
    main(*sys.argv[1:])
