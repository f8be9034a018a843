"""ORCA (van den Berg, Guy, Lin, Manocha: *Reciprocal n-body collision avoidance*, 2011) by the RVO2 library through ``pyrvo``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.evaluation.controllers.motion import Velocities, limit, rotate, steer
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Sensing


@dataclass(frozen=True)
class OrcaGains:
    """What is free in ORCA."""

    time_horizon: float = 1.5
    """Time ahead for which velocities are safe [s]."""
    margin: float = 0.009
    """Distance kept beyond the minimum separations [m]."""
    approach: float = 0.8
    """Preferred velocity for each meter to the waypoint [1/s]."""


class Orca:
    """The velocity nearest to one towards the waypoint that collides with nobody in sight for a while.

    Every vehicle solves its own problem from what it senses: itself and the bodies in range stand on an island of RVO2's
    plane, out of sight of all others. A vehicle's disc is half the minimum separation, an obstacle's the rest of its own.
    ORCA knows no links, and is meant for discs that move any way: :func:`steer` flies its velocity with a unicycle.

    :param gains: the default is the best of a search on other episodes (``tests/benchmarks/tune_controllers.py``)
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
        """Forget the last episode."""
        self._neighbors, self._obstacles = Velocities(), Velocities()

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The actions that fly ORCA's velocities."""
        gains, dt, speed = self.gains, scenario.time_step, scenario.max_speed
        own_radius = scenario.neighbor_separation / 2 + gains.margin / 2
        obstacle_radius = max(0.0, scenario.obstacle_separation + gains.margin - own_radius)
        wanted = limit(gains.approach * sensing.waypoint_positions, speed).reshape(-1, 2)
        forward, turns = sensing.moved.reshape(-1, 2).T
        velocities = rotate(np.stack((forward / dt, np.zeros_like(forward)), axis=-1), -turns)

        reach = 1.1 * max(scenario.link_range, scenario.detection_range)  # all that is in range, whatever the rounding
        simulator = self._new_simulator()  # a new one each time: pyrvo 0.4 keeps pointers to agents that were cleared
        simulator.set_time_step(dt)
        islands = _Islands(simulator, 5 * reach, len(wanted))
        for i, (velocity, wish) in enumerate(zip(velocities.tolist(), wanted.tolist(), strict=True)):
            islands.add(i, (0.0, 0.0), velocity, wish, own_radius, reach, gains.time_horizon, speed)
        for contacts, memory, n_bodies, radius in (
            (sensing.neighbors, self._neighbors, scenario.n_vehicles, own_radius),
            (sensing.obstacles, self._obstacles, scenario.n_obstacles, obstacle_radius),
        ):
            theirs = memory.update(contacts, n_bodies, sensing.moved, dt)
            rows = zip(contacts.observers.tolist(), contacts.positions.tolist(), theirs.tolist(), strict=True)
            for observer, position, velocity in rows:
                islands.add(observer, position, velocity, velocity, radius, 0.0, gains.time_horizon, speed)
        simulator.do_step()
        chosen = np.array([islands.velocity(i) for i in range(len(wanted))]).reshape(sensing.waypoint_positions.shape)
        return steer(chosen, scenario)

    def state_dict(self) -> dict[str, Any]:
        """What is remembered of the episodes under way: plain values and arrays."""
        return {"neighbors": self._neighbors.state_dict(), "obstacles": self._obstacles.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""
        self._neighbors, self._obstacles = Velocities(**state["neighbors"]), Velocities(**state["obstacles"])


class _Islands:
    """Agents around centers so far apart that those of one never see those of another."""

    def __init__(self, simulator: Any, gap: float, count: int) -> None:
        self.simulator, self.gap = simulator, gap
        self.columns = max(1, int(np.ceil(np.sqrt(count))))

    def add(
        self,
        island: int,
        position: Sequence[float],
        velocity: Sequence[float],
        wish: Sequence[float],
        radius: float,
        reach: float,
        horizon: float,
        speed: float,
    ) -> None:
        row, column = divmod(island, self.columns)
        place = (column * self.gap + position[0], row * self.gap + position[1])
        agent = self.simulator.add_agent(place, reach, _MOST_NEIGHBORS, horizon, horizon, radius, speed, velocity)
        self.simulator.set_agent_pref_velocity(agent, wish)

    def velocity(self, agent: int) -> tuple[float, float]:
        vector = self.simulator.get_agent_velocity(agent)
        return vector.x, vector.y


_MOST_NEIGHBORS = 20
"""Bodies that ORCA minds at most."""
