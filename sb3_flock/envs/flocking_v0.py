"""Flocking: vehicles track a moving waypoint together, keep apart, avoid obstacles and stay within communication range.

========================  ==========================================================================================
Import                    ``from sb3_flock import flocking_v0``, or ``pettingzoo.make("parallel", "flock/flocking-v0")``
Agents                    ``vehicle_0`` ... ``vehicle_{n-1}``; all live through the whole episode
Actions                   continuous, ``Box([0, -pi], [0.15, pi], (2,))``: speed v [m/s] and turn rate omega [rad/s]
Observations              ``Box(0, 1e6, (3, 11, 11), float32)``: neighbors, obstacles, waypoint in the body frame; with
                          ``motion_lag`` three motion channels more, within ``[-1e6, 1e6]``
Rewards                   r_i of section IV-B with our weights; training mixes in the neighbors' rewards
Termination, truncation   never terminated; all agents are truncated after ``max_cycles`` steps
Rendering                 ``human`` (a window) and ``rgb_array``; both need pygame, the ``render`` extra
========================  ==========================================================================================

**Observation.** ``obs[c, a, b]``: channel c (0 neighbors, 1 obstacles, 2 waypoint) at anchor a along the body's forward
axis and b along its left axis; see :mod:`sb3_flock.sim.observation`. The shape does not depend on the number of vehicles or
obstacles, so that one policy drives a flock of any size.

**Reward.** The sum of four named terms: ``connectivity`` rewards each neighbor at a safe distance and penalizes each
separation violation, ``obstacle`` penalizes each obstacle closer than its minimum separation, ``waypoint`` penalizes the
distance to the waypoint and ``control`` large actions.

**Infos** of a step, per agent (those of a reset are empty):

* ``neighbors``: indices into ``possible_agents`` of the agents within ``link_range``, ascending, as an int array;
* ``reward_terms``: the terms by name, floats that sum to the reward;
* ``metrics``: ``tracking_error`` (distance to the waypoint, m), ``nearest_neighbor`` and ``nearest_obstacle`` (m; inf if
  there is none at all), ``neighbor_violation`` and ``obstacle_violation`` (whether one is closer than its minimum
  separation), ``connected`` (whether the whole flock's proximity graph is connected);
* ``TimeLimit.truncated``: whether the time limit alone ended the episode, at the last step.

**Arguments.** Any field of :class:`sb3_flock.Scenario` by name (``n_vehicles``, ``n_obstacles``, ``max_cycles``, ...), or a
ready ``scenario``, and ``render_mode``.

**Several flocks.** With ``n_flocks`` the env holds independent copies of the task, simulated in one batch: the agents
``flock_0/vehicle_0``, ``flock_0/vehicle_1``, ..., ``flock_1/vehicle_0``, ... In the infos, ``neighbors`` are indices into the
agents of the same flock.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import parallel_to_aec

from sb3_flock.envs.batch import copy_flocks
from sb3_flock.settings import SettingsError, check_integer
from sb3_flock.sim import Scenario, Sensing, World, observe, own_reward, reward_terms
from sb3_flock.sim.dynamics import MAX_BODIES
from sb3_flock.sim.sensing import is_connected, nearest

if TYPE_CHECKING:
    from typing_extensions import Self

    from sb3_flock.sim.randomization import Ranges
    from sb3_flock.sim.safety import SafetySettings

Observation = NDArray[np.float32]
Action = NDArray[np.float32]


def env(**kwargs: Any) -> AECEnv:
    """The turn-based form with PettingZoo's usual wrappers: out-of-bounds actions are clipped, misuse is an error."""
    return wrappers.OrderEnforcingWrapper(wrappers.ClipOutOfBoundsWrapper(raw_env(**kwargs)))


def raw_env(**kwargs: Any) -> AECEnv:
    """The turn-based form of :class:`parallel_env`."""
    return parallel_to_aec(parallel_env(**kwargs))


def observation_space(scenario: Scenario) -> spaces.Box:
    """One vehicle's observation space; the same for any number of vehicles, so that a policy fits them all."""
    low = np.zeros(scenario.observation_shape, np.float32)
    low[len(scenario.channels) :] = -MAX_BODIES  # the motion channels are differences
    return spaces.Box(low, float(MAX_BODIES), dtype=np.float32)


def action_space(scenario: Scenario) -> spaces.Box:
    """One vehicle's action space: speed [m/s] and turn rate [rad/s]."""
    high = np.array([scenario.max_speed, scenario.max_turn_rate], dtype=np.float32)
    return spaces.Box(np.array([0.0, -high[1]], dtype=np.float32), high, dtype=np.float32)


class parallel_env(ParallelEnv[str, Observation, Action]):  # noqa: N801 - PettingZoo's name for it
    """The flocking task as a PettingZoo ``ParallelEnv``: a :class:`~sb3_flock.sim.World` of one flock, or of several.

    :param scenario: the task; fields given by name change it
    :param render_mode: ``None``, ``"human"`` or ``"rgb_array"``; the first flock is drawn
    :param n_flocks: number of independent flocks
    :param action_repeat: sampling periods that a step takes, with the same actions; rewards are means over them
    :param safety: the filters and their separations, if they are not the scenario's; ``fields`` do not change it
    :param randomization: ranges ``{"actuators.speed_lag": (0.0, 0.3)}`` from which fields of ``sensors`` and ``actuators`` are
        drawn for each flock and episode
    :param fields: fields of :class:`~sb3_flock.Scenario` by name
    :raises SettingsError: for an unknown field, a value that is not accepted or an unknown render mode

    :ivar n_copies: number of flocks; the agents are those of the first, then those of the second, ...
    :ivar rngs: each flock's random stream; empty before the first reset
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "flocking_v0",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": True,
        "render_fps": 10,
    }

    def __init__(
        self,
        scenario: Scenario | None = None,
        render_mode: str | None = None,
        n_flocks: int = 1,
        action_repeat: int = 1,
        safety: SafetySettings | None = None,
        randomization: Ranges | None = None,
        **fields: Any,
    ) -> None:
        check_integer("n_flocks", n_flocks, least=1)
        check_integer("action_repeat", action_repeat, least=1)
        self.action_repeat = action_repeat
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise SettingsError(f"render_mode = {render_mode!r}: one of {self.metadata['render_modes']} or None is needed")
        self.scenario = (scenario or Scenario()).replace(**fields)
        self.render_mode = render_mode
        self.n_copies = n_flocks
        vehicles = [f"vehicle_{i}" for i in range(self.scenario.n_vehicles)]
        self.possible_agents = (
            vehicles if n_flocks == 1 else [f"flock_{flock}/{name}" for flock in range(n_flocks) for name in vehicles]
        )
        self.agents: list[str] = []
        self._observation_spaces = {name: observation_space(self.scenario) for name in vehicles}
        self._action_spaces = {name: action_space(self.scenario) for name in vehicles}
        self.world = World(self.scenario, n_flocks, safety, randomization)
        self.rngs: list[np.random.Generator] = []
        self._renderer: Any = None

    def observation_space(self, agent: str) -> spaces.Box:
        """The observation space of an agent; the same object at every call."""
        return self._observation_spaces[agent.rpartition("/")[2]]

    def action_space(self, agent: str) -> spaces.Box:
        """The action space of an agent; the same object at every call."""
        return self._action_spaces[agent.rpartition("/")[2]]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode.

        :param seed: seeds flock i's random stream with ``seed + i``; without one the streams continue (the first reset draws
            fresh ones)
        :param options: ignored
        :return: observations and empty infos by agent
        """
        if seed is not None or not self.rngs:
            self.rngs = [np.random.default_rng(None if seed is None else seed + i) for i in range(self.n_copies)]
        self.agents = list(self.possible_agents)
        sensing = self.world.reset(self.rngs)
        return self._observations(sensing), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move everything by a sampling period, or by several; see the module's page for what comes back."""
        sensing, terms = self._advance(self.commands(actions))
        truncated = self.world.steps >= self.scenario.max_cycles
        infos = self._infos(sensing, terms, truncated)
        result = (
            self._observations(sensing),
            dict(zip(self.agents, own_reward(terms).ravel().tolist(), strict=True)),
            dict.fromkeys(self.agents, False),
            dict.fromkeys(self.agents, truncated),
            infos,
        )
        if truncated:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return result

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the flock: an ``(height, width, 3)`` image in ``rgb_array`` mode, a window in ``human`` mode.

        :raises ImportError: without pygame
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            from sb3_flock.envs.rendering import Renderer

            self._renderer = Renderer(self.scenario, self.render_mode, self.metadata["render_fps"])
        return self._renderer.draw(self.copy_at(0).world)

    def state(self) -> NDArray[np.float32]:
        """All agents' observations stacked, ``(agents, channels, l, l)``, without sensor errors and memory."""
        return observe(self.world.sense(), self.scenario).reshape(-1, *self.scenario.observation_shape)

    def copy_at(self, index: int) -> Self:
        """The env of one flock alone, to look at its present state; the env itself if there is one flock."""
        if self.n_copies == 1:
            return self
        one = copy.copy(self)
        one.n_copies, one.world, one._renderer = 1, World(self.scenario, safety=self.world.safety), None
        one.possible_agents = list(self._action_spaces)
        one.rngs = copy.deepcopy(self.rngs[index : index + 1])
        one.agents = list(one.possible_agents) if self.agents else []
        if self.rngs:
            copy_flocks(self.world, slice(index, index + 1), one.world)
        return one

    def state_dict(self) -> dict[str, Any]:
        """The current episodes and the random streams: plain values and arrays."""
        rngs = [rng.bit_generator.state for rng in self.rngs]
        return {"world": self.world.state_dict() if self.agents else None, "rngs": rngs}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the episodes of :meth:`state_dict`; what follows is equal to the last bit.

        :raises ValueError: for another number of flocks
        """
        if len(state["rngs"]) not in (0, self.n_copies):
            raise ValueError(f"the state is of {len(state['rngs'])} flocks: {self.n_copies} are needed")
        self.rngs = [np.random.default_rng() for _ in state["rngs"]]
        for rng, saved in zip(self.rngs, state["rngs"], strict=True):
            rng.bit_generator.state = saved
        self.agents = []
        if state["world"] is not None:
            self.world.load_state_dict(state["world"])
            self.agents = list(self.possible_agents)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _advance(self, commands: NDArray[np.float64]) -> tuple[Sensing, dict[str, NDArray[np.float64]]]:
        """Take the world's steps of one step: what is sensed at the end, and the means of the reward's terms."""
        steps = min(self.action_repeat, self.scenario.max_cycles - self.world.steps)
        sensing, totals = self._advance_once(commands)
        for _ in range(steps - 1):
            self.remember(sensing)  # the sensors remember every sampling period
            sensing, terms = self._advance_once(commands)
            totals = {name: totals[name] + term for name, term in terms.items()}
        return sensing, {name: total / steps for name, total in totals.items()} if steps > 1 else totals

    def _advance_once(self, commands: NDArray[np.float64]) -> tuple[Sensing, dict[str, NDArray[np.float64]]]:
        sensing, executed = self.world.step(commands)
        return sensing, reward_terms(sensing, executed, self.scenario.reward, self.scenario)

    def _observations(self, sensing: Sensing) -> dict[str, Observation]:
        observations = observe(self.measure(sensing), self.scenario)
        return dict(zip(self.possible_agents, observations.reshape(-1, *observations.shape[2:]), strict=True))

    def measure(self, sensing: Sensing) -> Sensing:
        """What the vehicles measure of what there is; the env calls it once a step, before it returns the observations."""
        return self.world.sensors.measure(sensing)

    def remember(self, sensing: Sensing) -> None:
        """Let the sensors measure between two steps of the env, where nothing is decided."""
        self.world.sensors.measure(sensing)

    def commands(self, actions: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """The actions for the world, ``(flocks, vehicles, 2)`` [m/s, rad/s]; the env calls it once a step."""
        given = np.array([actions[agent] for agent in self.agents], dtype=np.float64)
        return given.reshape(-1, self.scenario.n_vehicles, 2)

    def _infos(self, sensing: Sensing, terms: dict[str, NDArray[np.float64]], truncated: bool) -> dict[str, dict[str, Any]]:
        scenario, positions = self.scenario, self.world.positions
        nearest_neighbor = nearest(positions, positions, exclude_self=True)
        nearest_obstacle = nearest(positions, self.world.obstacle_positions)
        metrics = {
            "tracking_error": sensing.waypoint_distances,
            "nearest_neighbor": nearest_neighbor,
            "nearest_obstacle": nearest_obstacle,
            "neighbor_violation": nearest_neighbor < scenario.neighbor_separation,
            "obstacle_violation": nearest_obstacle < scenario.obstacle_separation,
            "connected": np.repeat(is_connected(sensing.neighbors), scenario.n_vehicles),
        }
        by_agent = zip(sensing.neighbors.by_observer(), _rows(terms), _rows(metrics), strict=True)
        end = {"TimeLimit.truncated": True} if truncated else {}
        return {
            agent: {"neighbors": neighbors, "reward_terms": own_terms, "metrics": own_metrics, **end}
            for agent, (neighbors, own_terms, own_metrics) in zip(self.agents, by_agent, strict=True)
        }


def _rows(columns: Mapping[str, NDArray[Any]]) -> list[dict[str, Any]]:
    """Arrays of one value an agent as one dict of Python numbers an agent."""
    rows = zip(*(column.ravel().tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]
