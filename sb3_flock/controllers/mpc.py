"""The privileged expert: model predictive control (MPC) of a whole flock from the full state of the world.

Only training uses the expert. A vehicle could not drive by it: the expert sees every body, not what one vehicle senses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sb3_flock.controllers.base import Controller, register_expert
from sb3_flock.settings import NotNegative, Positive, Settings, SettingsError
from sb3_flock.sim import Scenario, Sensing, World
from sb3_flock.sim.dynamics import directions_of
from sb3_flock.sim.sensing import nearest
from sb3_flock.sim.world import waypoints_ahead

Array = NDArray[np.float64]


class MPCConfig(Settings):
    """The cost and the optimizer of the MPC expert.

    The cost is the mean distance to the waypoint plus, for each constraint, its weight times half the squared violation.
    Lengths are scaled so that the link range is 0.15 m: the same weights serve tasks of any size.
    """

    separation: Positive = Field(
        1.06, description="distance to keep between vehicles [minimum separations of the training env]"
    )
    clearance: Positive = Field(1.033, description="distance to keep to obstacles [minimum separations of the training env]")
    max_link_length: Positive = Field(0.93, description="longest link without cost [link ranges]")
    link_cutoff: Positive = Field(
        2 / 3, description="excess over max_link_length from which a link no longer counts [link ranges]"
    )
    separation_weight: NotNegative = Field(500.0, description="weight of separation violations [1/m]")
    clearance_weight: NotNegative = Field(1000.0, description="weight of clearance violations [1/m]")
    link_weight: NotNegative = Field(60.0, description="weight of links that are too long [1/m]")
    obstacle_visibility: NotNegative = Field(
        1.0, description="distance to the nearest vehicle within which the expert sees an obstacle [detection ranges]"
    )
    horizon: int = Field(20, ge=1, le=1000, description="planning horizon [steps]")
    n_iterations: int = Field(200, ge=1, le=1_000_000, description="gradient steps of the optimizer at each decision")
    step_size: Positive = Field(
        0.06, description="the optimizer's step size at its first iteration, a tenth of it at the last [action bounds]"
    )


class MPC(Controller):
    """Optimizes the controls of all vehicles over the horizon by gradient descent, and applies the first ones.

    The model is the unicycle itself. The cost keeps vehicles near the waypoint's future positions, apart from each other and
    from obstacles, and linked. The expert sees an obstacle as soon as one vehicle detects it, and predicts it straight ahead
    at its mean speed of the episode. Every optimization starts from standing still: the present state alone determines the
    actions, so that a policy can imitate them.

    :param world: the world to read the full state from, whatever is sensed in it
    :param config: the cost and the optimizer
    :raises SettingsError: if ``numba`` is not installed
    """

    def __init__(self, world: World, config: MPCConfig | None = None) -> None:
        try:
            from sb3_flock.controllers.mpc_kernels import UNIT_LINK, CostParams, FilterParams, optimize
        except (ImportError, RuntimeError) as error:  # RuntimeError: as in sb3_flock.sim.backend
            raise SettingsError(f"expert = 'mpc': needs numba, pip install 'sb3_flock[fast]' ({error})") from None
        self.world, self.config, self._optimize = world, config or MPCConfig(), optimize
        scenario = world.scenario
        self._unit = scenario.link_range / UNIT_LINK
        self._cost = CostParams(
            self.config.separation * scenario.neighbor_separation / self._unit,
            self.config.clearance * scenario.obstacle_separation / self._unit,
            self.config.max_link_length * UNIT_LINK,
            self.config.link_cutoff * UNIT_LINK,
            self.config.separation_weight,
            self.config.clearance_weight,
            self.config.link_weight,
        )
        safety = world.safety
        level = safety.safety_filter
        self._filter = FilterParams(
            (safety.neighbor_separation + safety.safety_margin) / self._unit,
            {"off": 0, "announce": 2}.get(level, 1),
            level != "voronoi",
        )

    def act(self, sensing: Sensing, scenario: Scenario) -> Array:
        """The first controls of the plans, ``(flocks, vehicles, 2)`` [m/s, rad/s]."""
        world, config = self.world, self.config
        ahead = np.arange(1, config.horizon + 1)
        visible = nearest(world.obstacle_positions, world.positions) < config.obstacle_visibility * scenario.detection_range
        positions, waypoints, obstacles = (
            points / self._unit
            for points in (world.positions, predict_waypoints(world, ahead), predict_obstacles(world, ahead))
        )
        max_step, max_turn = world.action_high * scenario.time_step / (self._unit, 1.0)
        plans = np.zeros((world.n_flocks, scenario.n_vehicles, config.horizon, 2))
        for flock, plan in enumerate(plans):
            state = positions[flock], world.headings[flock]
            predicted = np.ascontiguousarray(obstacles[flock][:, visible[flock]])
            optimizer = config.n_iterations, config.step_size
            self._optimize(
                plan, *state, waypoints[flock], predicted, max_step, max_turn, self._cost, self._filter, *optimizer
            )
        return plans[:, :, 0] * world.action_high


def predict_waypoints(world: World, ahead: NDArray[np.integer]) -> Array:
    """The waypoint's future positions, ``(flocks, ahead, 2)`` [m], after each number of steps in ``ahead``."""
    steps = np.broadcast_to(ahead, (world.n_flocks, len(ahead)))
    return waypoints_ahead(world.scenario, world.waypoints, world.steps, steps)


def predict_obstacles(world: World, ahead: NDArray[np.integer]) -> Array:
    """The obstacles' expected positions, ``(flocks, ahead, obstacles, 2)`` [m]: straight on at their mean speed."""
    mean_speeds = world.obstacle_speeds.mean(0)[..., None]
    strides = mean_speeds * directions_of(world.obstacle_headings) * world.scenario.time_step
    return world.obstacle_positions[:, None] + strides[:, None] * ahead[:, None, None]


register_expert("mpc", MPC)
