"""ORCA (van den Berg, Guy, Lin, Manocha: *Reciprocal n-body collision avoidance*, 2011) by the RVO2 library through ``pyrvo``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller, register_controller, register_expert
from sb3_flock.controllers.motion import Velocities, limit, steer
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Sensing
from sb3_flock.sim.sensing import rotate


@dataclass(frozen=True)
class OrcaGains:
    """Free parameters of ORCA."""

    time_horizon: float = 1.5
    """Time horizon over which velocities are collision-free [s]."""
    margin: float = 0.009
    """Distance kept beyond the minimum separations [m]."""
    approach: float = 0.8
    """Preferred velocity for each meter to the waypoint [1/s]."""


@register_controller("orca")
class Orca(Controller):
    """The velocity nearest to one towards the waypoint that collides with no sensed body over the time horizon.

    Every vehicle solves its own problem from what it senses: in RVO2's plane, the vehicle and the bodies in its range are
    placed out of range of all other vehicles' problems. RVO2 computes in single precision, so that a place far from the origin
    rounds its coordinates: each flock has a plane of its own, and its actions do not depend on the number of flocks.
    A vehicle's disc is half the minimum separation, an obstacle's the rest of its own.
    ORCA does not keep links, and assumes holonomic discs: :func:`steer` turns its velocity into a unicycle's actions.

    :param gains: the default is the best of a search on separate episodes (``tests/benchmarks/tune_controllers.py``)
    :raises SettingsError: if ``pyrvo`` is not installed
    """

    def __init__(self, gains: OrcaGains | None = None) -> None:
        self.gains = gains or OrcaGains()
        try:
            import pyrvo
        except ImportError:
            raise SettingsError("controller = 'orca': needs pyrvo, pip install 'sb3_flock[orca]'") from None
        self._new_simulator = pyrvo.RVOSimulator

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Clear the memory of the last episode."""
        self._neighbors, self._obstacles = Velocities(), Velocities()

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The actions ``(flocks, vehicles, 2)`` [m/s, rad/s]."""
        gains, dt, speed = self.gains, scenario.time_step, scenario.max_speed
        own_radius = scenario.neighbor_separation / 2 + gains.margin / 2
        obstacle_radius = max(0.0, scenario.obstacle_separation + gains.margin - own_radius)
        preferred = limit(gains.approach * sensing.waypoint_positions, speed).reshape(-1, 2)
        forward, turns, *across = np.moveaxis(sensing.ego_motion.reshape(-1, sensing.ego_motion.shape[-1]), -1, 0)
        left = across[0] / dt if across else np.zeros_like(forward)
        velocities = rotate(np.stack((forward / dt, left), axis=-1), -turns)

        sensing_range = 1.1 * max(
            scenario.link_range, scenario.detection_range
        )  # everything in range, whatever the rounding
        flocks, vehicles, _ = sensing.waypoint_positions.shape
        planes = [_Groups(self._new_simulator(), dt, 5 * sensing_range, vehicles) for _ in range(flocks)]
        for i, (velocity, preferred_velocity) in enumerate(zip(velocities.tolist(), preferred.tolist(), strict=True)):
            planes[i // vehicles].add(
                i % vehicles, (0.0, 0.0), velocity, preferred_velocity, own_radius, sensing_range, gains.time_horizon, speed
            )
        for contacts, memory, n_bodies, radius in (
            (sensing.neighbors, self._neighbors, scenario.n_vehicles, own_radius),
            (sensing.obstacles, self._obstacles, scenario.n_obstacles, obstacle_radius),
        ):
            theirs = memory.update(contacts, n_bodies, sensing.ego_motion, dt)
            rows = zip(contacts.observers.tolist(), contacts.positions.tolist(), theirs.tolist(), strict=True)
            for observer, position, velocity in rows:
                planes[observer // vehicles].add(
                    observer % vehicles, position, velocity, velocity, radius, 0.0, gains.time_horizon, speed
                )
        chosen = np.array([plane.velocities() for plane in planes]).reshape(sensing.waypoint_positions.shape)
        return steer(chosen, scenario)

    def state_dict(self) -> dict[str, Any]:
        """The memory of the current episodes: plain values and arrays."""
        return {"neighbors": self._neighbors.state_dict(), "obstacles": self._obstacles.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._neighbors, self._obstacles = Velocities(**state["neighbors"]), Velocities(**state["obstacles"])


class _Groups:
    """Groups of RVO2 agents around centers so far apart that no agent of one group is in range of another group.

    :param simulator: a new one for each step: pyrvo 0.4 keeps pointers to cleared agents
    """

    def __init__(self, simulator: Any, time_step: float, gap: float, count: int) -> None:
        self.simulator, self.gap, self.count = simulator, gap, count
        self.simulator.set_time_step(time_step)
        self.columns = max(1, int(np.ceil(np.sqrt(count))))

    def add(
        self,
        group: int,
        position: Sequence[float],
        velocity: Sequence[float],
        preferred_velocity: Sequence[float],
        radius: float,
        sensing_range: float,
        horizon: float,
        speed: float,
    ) -> None:
        row, column = divmod(group, self.columns)
        place = (column * self.gap + position[0], row * self.gap + position[1])
        agent = self.simulator.add_agent(place, sensing_range, _MAX_NEIGHBORS, horizon, horizon, radius, speed, velocity)
        self.simulator.set_agent_pref_velocity(agent, preferred_velocity)

    def velocities(self) -> list[tuple[float, float]]:
        """The velocity after one step of the agent that was added first to each group."""
        self.simulator.do_step()
        vectors = (self.simulator.get_agent_velocity(agent) for agent in range(self.count))
        return [(vector.x, vector.y) for vector in vectors]


_MAX_NEIGHBORS = 20
"""Largest number of bodies that ORCA considers."""


register_expert("orca", lambda world, mpc: Orca())
