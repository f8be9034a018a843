"""Bodies that move as a baseline's velocities say, without a unicycle between: what the articles and their software compute."""

import numpy as np

from sb3_flock.sim import episode_rng
from sb3_flock.sim.sensing import rotate, sense


class Holonomic:
    """One flock of discs under a controller; every step they also turn, as a vehicle's frame does.

    :param module: the controller's module, whose ``steer`` is put aside
    """

    def __init__(self, module, monkeypatch, controller, scenario, positions, obstacles=()):
        monkeypatch.setattr(module, "steer", lambda velocities, scenario: velocities)
        self.controller, self.scenario = controller, scenario
        self.positions = np.array(positions, dtype=float)
        self.obstacles = np.array(obstacles, dtype=float).reshape(-1, 2)
        self.velocities = np.zeros_like(self.positions)
        self.rng = np.random.default_rng(0)
        self.headings = self.rng.uniform(-np.pi, np.pi, len(self.positions))
        self.ego_motion = np.zeros((1, len(self.positions), 3))
        controller.reset([episode_rng(0, 0)], scenario)

    def step(self, goals=None, obstacle_velocities=0.0):
        """Move for one step; each body's goal ``(bodies, 2)`` stands in place of the waypoint."""
        goals = np.zeros_like(self.positions) if goals is None else np.asarray(goals)
        frames = np.stack((np.cos(self.headings), np.sin(self.headings)), axis=-1)
        sensing = sense(
            self.positions[None], frames[None], self.obstacles[None], np.zeros((1, 2)), self.scenario, self.ego_motion
        )
        sensing.waypoint_positions[0] = rotate(goals - self.positions, -self.headings)
        self.velocities = rotate(self.controller.act(sensing, self.scenario)[0], self.headings)
        self.advance(self.velocities, obstacle_velocities)

    def advance(self, velocities, obstacle_velocities=0.0):
        """Move with given velocities in place of the controller's."""
        moved = np.asarray(velocities) * self.scenario.time_step
        ahead = rotate(moved, -self.headings)
        turns = self.rng.uniform(-0.3, 0.3, len(moved))
        self.ego_motion = np.stack((ahead[:, 0], turns, ahead[:, 1]), axis=-1)[None]
        self.positions = self.positions + moved
        self.headings = self.headings + turns
        self.obstacles = self.obstacles + np.asarray(obstacle_velocities) * self.scenario.time_step
