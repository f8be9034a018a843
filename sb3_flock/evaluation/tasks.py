"""The tasks of the tables: the paper's experiments, and a harder one of ours."""

from __future__ import annotations

from sb3_flock.sim import Scenario

EXPERIMENTS = {
    "3v1o": Scenario(n_vehicles=3, n_obstacles=1),
    "5v1o": Scenario(n_vehicles=5, n_obstacles=1),
    "5v2o": Scenario(n_vehicles=5, n_obstacles=2),
}
"""The paper's experiments by name (section V)."""

CROSSING = {"5v2o-crossing": Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")}
"""Tasks with obstacles that cross the flock by name."""

TASKS = {**EXPERIMENTS, **CROSSING}


def with_bodies_of(scenario: Scenario, task: Scenario) -> Scenario:
    """A policy's own scenario (its observation, its ranges, its filter) with the vehicles and the obstacles of a task."""
    return scenario.replace(**{name: getattr(task, name) for name in ("n_vehicles", "n_obstacles", "obstacle_motion")})
