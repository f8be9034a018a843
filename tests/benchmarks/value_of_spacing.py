"""The critics' value of a tight flock and the true one: ``python tests/benchmarks/value_of_spacing.py ddpg value.png``.

Three vehicles stand around the waypoint, each at the same distance from the other two, with random headings. The critics' value
of this state is compared with the discounted reward that the same policy then collects in the training env, without and with
exploration noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch as th

from sb3_flock import load_policy
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.serialization.load import LoadedPolicy
from sb3_flock.sim import Scenario, World, episode_rng, observe, own_reward, reward_terms
from sb3_flock.viz.figures import new_figure, save_as

SPACINGS = np.round(np.arange(0.09, 0.1491, 0.003), 3)
FLOCKS = 256
STEPS = 75
"""Steps of the training env; later rewards are discounted to almost nothing."""
NOISE = 0.1
"""Standard deviation of the exploration noise [half the action range]."""


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


def predicted_value(policy: LoadedPolicy, world: World) -> float:
    """The mean of the smaller critic's values, in units of the unscaled reward."""
    observations = th.as_tensor(observe(world.sense(), world.scenario)).flatten(0, 1)
    with th.no_grad():
        values = th.cat(policy.policy.critic(observations, policy.policy.actor(observations)), dim=1).amin(1)
    return values.mean().item() / world.scenario.reward.scale


def collected_value(policy: LoadedPolicy, world: World, noise: float) -> float:
    """The mean discounted reward of the episodes that start in this state, unscaled."""
    controller, scenario, rng = PolicyController(policy), world.scenario, np.random.default_rng(1)
    sensing, total = world.sense(), 0.0
    half_range = (world.action_high - world.action_low) / 2
    for step in range(min(STEPS, scenario.max_cycles)):
        actions = controller.act(world.sensors.measure(sensing), scenario)
        sensing, clipped = world.step(actions + noise * half_range * rng.normal(size=actions.shape))
        reward = own_reward(reward_terms(sensing, clipped, scenario.reward, scenario)).mean()
        total += policy.config.algorithm.gamma**step * float(reward)
    return total / scenario.reward.scale


def main(name: str, picture: str | None = None) -> None:
    """Print the three values by spacing, and plot them if a file is given."""
    th.set_num_threads(1)
    policy = load_policy(name)
    scenario = policy.config.training_scenarios()[0].replace(n_vehicles=3, n_obstacles=0)
    columns = {
        "predicted": [predicted_value(policy, triangles(scenario, spacing)) for spacing in SPACINGS],
        "true": [collected_value(policy, triangles(scenario, spacing), 0.0) for spacing in SPACINGS],
        f"true, with noise {NOISE}": [collected_value(policy, triangles(scenario, spacing), NOISE) for spacing in SPACINGS],
    }
    print("spacing", *columns, sep="  ")
    for spacing, *values in zip(SPACINGS, *columns.values(), strict=True):
        print(f"{spacing:.3f}", *(f"{value:8.2f}" for value in values))
    if picture:
        figure, axes = new_figure()
        for (label, values), style in zip(columns.items(), ("o-", "s--", "^:"), strict=True):
            axes.plot(SPACINGS, values, style, color="black", markersize=4, label=label)
        axes.axvline(scenario.neighbor_separation, color="gray", linewidth=1)
        axes.set(
            xlabel="spacing [m] (line: minimum separation of the training env)",
            ylabel="value [rewards]",
            title=f"three at rest, {name}",
        )
        axes.grid(alpha=0.3)
        axes.legend()
        save_as(figure, Path(picture), Path(picture).suffix[1:])


if __name__ == "__main__":
    main(*sys.argv[1:])
