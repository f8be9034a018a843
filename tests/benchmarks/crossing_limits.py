"""How closely a flock could track while obstacles cross it: ``python tests/benchmarks/crossing_limits.py``.

First a bound: at each settled moment by itself, five places of a hexagonal lattice, free of the obstacles and connected, as
near to the waypoint as possible. Then flights of two planners that see everything, what comes included, and let ORCA fly their
goals:

- `aside` moves the goal of the whole flock out of the obstacles' way;
- `places` gives each vehicle its own place in such a pack, the one with the shortest ways.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.controllers import Orca
from sb3_flock.evaluation.controllers.motion import rotate
from sb3_flock.evaluation.controllers.orca import OrcaGains
from sb3_flock.evaluation.metrics import EpisodeMetrics
from sb3_flock.sim import Scenario, World, episode_rng, own_reward, reward_terms

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1

Array = NDArray[np.float64]


class Packs:
    """Packs of five around the waypoint, cut from lattices of many angles and offsets, some leaning to one side.

    :param spacing: between neighbors of the lattice [m]
    """

    def __init__(self, spacing: float, lattices: int = 40) -> None:
        rng = np.random.default_rng(0)
        grid = np.array([(i + j / 2, j * np.sqrt(3) / 2) for i in range(-6, 7) for j in range(-6, 7)])
        angles, offsets = rng.uniform(0, np.pi / 3, lattices), rng.uniform(-0.5, 0.5, (lattices, 1, 2))
        turn = np.stack([np.cos(angles), np.sin(angles), -np.sin(angles), np.cos(angles)], axis=-1).reshape(-1, 2, 2)
        self.spacing, self.places = spacing, spacing * (grid + offsets) @ turn
        self.distances = np.linalg.norm(self.places, axis=-1)
        leanings = [lean * np.array([np.cos(a), np.sin(a)]) for lean in (0.3, 0.8) for a in np.arange(8) * np.pi / 4]
        self.orders = np.stack([self.distances - self.places @ lean for lean in [np.zeros(2), *leanings]], axis=1)

    def free(self, obstacles: Array, clearance: float) -> tuple[Array, Array]:
        """Connected packs with no place within ``clearance`` [m] of ``obstacles`` ``(any, 2)``, and their mean distances."""
        away = np.linalg.norm(self.places[..., None, :] - obstacles, axis=-1).min(-1, initial=np.inf)
        orders = np.where((away >= clearance)[:, None], self.orders, np.inf)
        chosen = np.argpartition(orders, 5, axis=-1)[..., :5].reshape(-1, 5)
        lattice = np.repeat(np.arange(len(self.places)), self.orders.shape[1])[:, None]
        packs = self.places[lattice, chosen]
        linked = np.linalg.norm(packs[:, :, None] - packs[:, None], axis=-1) < 1.01 * self.spacing
        whole = np.linalg.matrix_power(linked.astype(np.int64), 4).all(axis=(1, 2))
        return packs[whole], self.distances[lattice, chosen][whole].mean(1)


Planner = Callable[[World, Array, Array], Array]
"""From the world and the obstacles' positions and velocities ``(flocks, obstacles, 2)``, seen from the waypoint, to goals
``(flocks, vehicles, 2)``, seen from there, too."""


def aside(weight: float, ahead: float, keep: float = 0.25) -> Planner:
    """One goal for all, ``keep`` [m] away from where obstacles will be within ``ahead`` [s]: the nearest, and near the last."""
    axis = np.linspace(-0.35, 0.35, 29)
    goals = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    times = np.arange(0, ahead + 0.01, 0.25)
    last = np.zeros((1, 2))

    def plan(world: World, positions: Array, velocities: Array) -> Array:
        nonlocal last
        courses = positions[:, :, None] + velocities[:, :, None] * times[:, None]
        gaps = np.linalg.norm(goals[:, None, None] - courses[:, None], axis=-1)
        costs = np.linalg.norm(goals, axis=-1) + 6 * np.maximum(0, keep - gaps).max(-1).sum(-1)
        last = goals[np.argmin(costs + weight * np.linalg.norm(goals - last[:, None], axis=-1), axis=1)]
        return np.broadcast_to(last[:, None], world.positions.shape)

    return plan


def places(weight: float, ahead: tuple[float, ...]) -> Planner:
    """A place for each, in a pack free of the obstacles ``ahead`` [s]: near the waypoint, and with short ways."""
    packs, orders = Packs(0.112), np.array(list(itertools.permutations(range(5))))

    def plan(world: World, positions: Array, velocities: Array) -> Array:
        goals = np.empty_like(world.positions)
        for flock, vehicles in enumerate(world.positions - world.waypoints[:, None]):
            courses = np.concatenate([positions[flock] + velocities[flock] * time for time in ahead])
            found, distances = packs.free(courses, 0.165)
            nearest = np.argsort(distances)[:40]
            ways = np.linalg.norm(vehicles[:, None] - found[nearest][:, None], axis=-1)
            sums = ways[:, np.arange(5), orders].mean(-1)
            best = np.argmin(distances[nearest] + weight * sums.min(1))
            goals[flock] = found[nearest[best]][orders[np.argmin(sums[best])]]
        return goals

    return plan


def flown(planner: Planner | None, episodes: int, gains: OrcaGains | None = None) -> dict[str, Array]:
    """The metrics of a planner's flights; ``None``: ORCA by itself."""
    world, orca, metrics = World(CROSSING, episodes), Orca(gains), EpisodeMetrics(CROSSING, episodes)
    rngs = [episode_rng(SEED, episode) for episode in range(episodes)]
    sensing = world.reset(rngs)
    orca.reset(rngs, CROSSING)
    for step in range(CROSSING.max_cycles):
        if planner is not None:
            wanted = planner(world, world.obstacle_positions - world.waypoints[:, None], _velocities(world, step))
            offsets = wanted + world.waypoints[:, None] - world.positions
            sensing = replace(sensing, waypoint_positions=rotate(offsets, -world.headings))
        sensing, clipped = world.step(orca.act(sensing, CROSSING))
        metrics.update(world, sensing, own_reward(reward_terms(sensing, clipped, CROSSING)))
    return metrics.result()


def bound(episodes: int) -> float:
    """The least mean distance of connected packs 0.1 m apart, 0.15 m from obstacles, over the settled moments."""
    packs, world = Packs(CROSSING.neighbor_separation, lattices=200), World(CROSSING, episodes)
    world.reset([episode_rng(SEED, episode) for episode in range(episodes)])
    least = []
    for step in range(1, CROSSING.max_cycles + 1):
        world.step(np.zeros((episodes, 5, 2)))
        if 2 * step > CROSSING.max_cycles and step % 10 == 0:
            for obstacles in world.obstacle_positions - world.waypoints[:, None]:
                least.append(packs.free(obstacles, CROSSING.obstacle_separation)[1].min())
    return float(np.mean(least))


def _velocities(world: World, step: int) -> Array:
    headings = np.stack((np.cos(world.obstacle_headings), np.sin(world.obstacle_headings)), axis=-1)
    return world.obstacle_speeds[step][..., None] * headings


def main(episodes: int = 100) -> None:
    """Print the bound and a line a planner."""
    print(f"bound on the tracking error: {bound(episodes):.3f} m")
    planners = {
        "orca by itself": (None, None),
        **{f"aside, {ahead} s ahead": (aside(0.3, ahead), None) for ahead in (1.5, 2.5, 3.5)},
        "aside, 2.5 s ahead, staying": (aside(1.0, 2.5), None),
        **{
            f"places, {ahead[-1]} s ahead": (places(weight, ahead), OrcaGains(approach=2.0))
            for weight, ahead in ((0.2, (0.5, 1.0, 1.5)), (1.0, (1.0, 2.0)))
        },
    }
    columns = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity")
    print("planner", *columns, sep="; ")
    for name, (planner, gains) in planners.items():
        metrics = flown(planner, episodes, gains)
        print(name, *(f"{np.nanmean(metrics[column]):.4f}" for column in columns), sep="; ", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
