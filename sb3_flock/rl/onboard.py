"""A policy for a vehicle's computer: one ONNX graph from what is measured to what is commanded, tensor included."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_flock.rl.loading import LoadedPolicy
from sb3_flock.rl.saving import versions, write_whole
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, observe
from sb3_flock.sim.sensing import find_contacts
from sb3_flock.sim.sensors import SensorErrors

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

INPUTS = ("neighbors", "obstacles", "waypoint")
EARLIER_INPUTS = ("neighbors_before", "obstacles_before", "waypoint_before", "moved")
"""Further inputs for a policy with a second look."""
TOLERANCE = 1e-5
"""Largest difference to ``predict`` that an exported policy may have, as a share of the action's range; it is float32's."""

Situation = dict[str, "NDArray[np.float64]"]
"""The inputs of the graph by name."""


@dataclass(frozen=True)
class Export:
    """What was written, and how it compares with the policy."""

    path: Path
    situations: int
    difference: float
    """Largest difference to ``predict`` in those situations, as a share of the action's range."""
    latency: float
    """Median time of a decision on one core [s]."""


_NOTHING = th.empty(0)
"""What was before, for a policy that looks once."""


class Onboard(nn.Module):
    """The vehicle's side of a policy: the tensor of section IV-A, the actor, and physical units.

    ``forward(neighbors, obstacles, waypoint)`` takes the positions of other vehicles ``(any number, 2)``, of obstacles ``(any
    number, 2)`` and of the waypoint ``(2,)``, all in the body frame [m] (forward is +x, left is +y) and float64, as NumPy has
    it; what is out of its range is left out as in :func:`~sb3_flock.sim.sense`. It gives ``(2,)``: speed [m/s] and turn rate
    [rad/s].

    With a second look it also takes what was measured ``look_back`` ago, ``neighbors_before``, ``obstacles_before`` and
    ``waypoint_before`` in the body frame of then, and ``moved`` ``(3,)``: where the vehicle is now in that frame [m, m] and how
    far it has turned since [rad]. Until it has flown that long: what was measured first.

    It counts in float64 throughout: where a policy turns about, float32 is off by 1e-5 rad/s, and the time goes elsewhere.

    :param policy: a policy of DDPG, TD3 or SAC for the flock's tensor
    :param scenario: the task, whose ranges it flies with
    :raises SettingsError: for another kind of policy
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: Any, scenario: Scenario) -> None:
        super().__init__()
        self.scenario = scenario
        actor: Any = getattr(policy, "actor", None)
        if isinstance(policy, TD3Policy):
            parts = [actor.features_extractor, actor.mu]
        elif isinstance(policy, SACPolicy):
            parts = [actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh()]
        else:
            raise SettingsError(f"export: a policy of DDPG, TD3 or SAC is needed, not {type(policy).__name__}")
        self.actor = copy.deepcopy(nn.Sequential(*parts)).double()
        self.register_buffer("low", th.tensor(policy.action_space.low, dtype=th.float64))
        self.register_buffer("high", th.tensor(policy.action_space.high, dtype=th.float64))

    def forward(
        self,
        neighbors: th.Tensor,
        obstacles: th.Tensor,
        waypoint: th.Tensor,
        neighbors_before: th.Tensor = _NOTHING,
        obstacles_before: th.Tensor = _NOTHING,
        waypoint_before: th.Tensor = _NOTHING,
        moved: th.Tensor | None = None,
    ) -> th.Tensor:
        """The deterministic action, ``(2,)``."""
        bodies = [neighbors, obstacles, waypoint[None]]
        seen = self._in_range(bodies)
        if moved is not None:
            before = [neighbors_before, obstacles_before, waypoint_before[None]]
            seen += self._in_range(before)
            cos, sin = moved[2].cos(), moved[2].sin()
            frame = th.stack((th.stack((cos, -sin)), th.stack((sin, cos))))  # of now, as seen from the frame of then
            bodies += [(positions - moved[:2]) @ frame for positions in before]
        action = self.actor(self._tensor(bodies, seen)[None])[0]
        return self.low + (action + 1) / 2 * (self.high - self.low)

    def _in_range(self, bodies: list[th.Tensor]) -> list[th.Tensor]:
        ranges = (self.scenario.link_range, self.scenario.detection_range, float("inf"))
        return [_norm(positions) < reach for positions, reach in zip(bodies, ranges, strict=True)]

    def _tensor(self, bodies: list[th.Tensor], seen: list[th.Tensor]) -> th.Tensor:
        """All channels at once, for speed: bodies marked by their channel's number, lengths in units of its sigma."""
        scenario, side, channels = self.scenario, self.scenario.n_anchors, len(bodies)
        bodies = [
            positions / (_norm(positions) / scenario.goal_radius).clamp(min=1.0)[:, None] if number % 3 == 2 else positions
            for number, positions in enumerate(bodies)
        ]
        radii = th.tensor(scenario.channel_radii * (channels // 3), dtype=th.float64)
        anchors = th.linspace(-1, 1, side, dtype=th.float64) * (side - 1) / (2 * scenario.anchor_width)
        marked = th.cat(
            [nn.functional.pad(positions, (0, 1), value=float(number)) for number, positions in enumerate(bodies)]
        )
        positions, channel = marked[:, :2], marked[:, 2].long()
        sigma = scenario.anchor_width * 2 * radii / (side - 1)
        factors = th.exp(-0.5 * ((positions / sigma[channel, None])[:, :, None] - anchors).square())
        spots = (factors[:, 0, :, None] * factors[:, 1, None, :]).flatten(1)
        counts = (channel == th.arange(channels)[:, None]) & th.cat(seen)
        tensor = (counts.double() @ spots).view(channels, side, side)
        return tensor if channels == 3 else th.cat((tensor[:3], tensor[:3] - tensor[3:]))


def _norm(vectors: th.Tensor) -> th.Tensor:
    return vectors.square().sum(-1).sqrt()


def export(policy: LoadedPolicy, path: str | Path, situations: int = 1000, seed: int = 0) -> Export:
    """Write a policy as ONNX, if it decides there as it does here.

    The graph is that of :class:`Onboard`, its inputs are :data:`INPUTS`, with a second look :data:`EARLIER_INPUTS` as well, its
    output is ``action``. What else a vehicle needs to know (ranges, sampling period, units) is in the file's metadata under
    ``sb3_flock``, as JSON.

    :param path: the file, which is written whole or not at all
    :param situations: number of random situations in which it is compared with ``predict``
    :param seed: of the situations
    :raises SettingsError: if a library is not installed or there is no such folder
    :raises RunError: if it differs from ``predict`` by more than :data:`TOLERANCE`
    :raises OSError: if it cannot be written
    """
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise SettingsError(f"export {path}: there is no folder {path.parent}")
    try:
        import onnx
        import onnxruntime
        import onnxscript  # noqa: F401 - torch's exporter needs it
    except ImportError as error:
        raise SettingsError(f"export needs {error.name}: pip install 'sb3_flock[onnx]'") from None
    scenario = policy.scenario
    module = Onboard(policy.policy, scenario).eval()
    inputs = inputs_of(scenario)
    any_number = {0: th.export.Dim.DYNAMIC}
    shapes = {"waypoint": (2,), "waypoint_before": (2,), "moved": (3,)}
    with _quiet_exporter(), th.no_grad():
        program = th.onnx.export(
            module,
            tuple(th.zeros(*shapes.get(name, (2 + number, 2)), dtype=th.float64) for number, name in enumerate(inputs)),
            input_names=inputs,
            output_names=["action"],
            dynamic_shapes=tuple(None if name in shapes else any_number for name in inputs),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.doc_string = " ".join(str(Onboard.__doc__).split(":param", maxsplit=1)[0].replace("``", "").split())
    onnx.helper.set_model_props(model, {"sb3_flock": json.dumps(_metadata(policy))})
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    difference, latency = _compare(session, policy, situations, seed)
    if not difference <= TOLERANCE:
        raise RunError(
            f"export {path}: the graph differs from the policy by {difference:.2g} of the range, more than {TOLERANCE:g}"
        )
    with write_whole(path) as aside:
        aside.write_bytes(model.SerializeToString())
    return Export(path, situations, difference, latency)


def inputs_of(scenario: Scenario) -> tuple[str, ...]:
    """Names of the inputs of a policy's graph, in their order."""
    return (*INPUTS, *EARLIER_INPUTS) if scenario.look_back else INPUTS


def _metadata(policy: LoadedPolicy) -> dict[str, Any]:
    scenario = policy.scenario
    names = ("link_range", "detection_range", "neighbor_separation", "obstacle_separation", "time_step", "max_speed")
    inputs = "positions in the body frame [m], forward +x, left +y: neighbors (any, 2), obstacles (any, 2), waypoint (2,)"
    if scenario.look_back:
        inputs += "; ..._before: those of look_back [s] ago, in the frame of then; moved (3,): own place in it, turn [rad]"
    return {
        **policy.describe(),
        "policy": policy.path.name,
        "inputs": inputs,
        "output": "action (2,): speed [m/s], turn rate [rad/s]",
        **{name: getattr(scenario, name) for name in (*names, "max_turn_rate", "look_back")},
        "exported_with": versions(),
    }


def _compare(session: Any, policy: LoadedPolicy, count: int, seed: int) -> tuple[float, float]:
    """Largest difference to ``predict`` and median time of a decision."""
    space: Any = policy.policy.action_space
    situations = list(random_situations(policy.scenario, count, seed))
    actions, times = [], []
    for situation, _ in situations:
        start = time.perf_counter()
        (action,) = session.run(None, situation)
        times.append(time.perf_counter() - start)
        actions.append(action)
    expected = np.stack([policy.predict(tensor, deterministic=True)[0] for _, tensor in situations])
    difference = np.abs(np.stack(actions) - expected) / (space.high - space.low)
    return float(difference.max()), float(np.median(times))


def random_situations(scenario: Scenario, count: int, seed: int) -> Iterator[tuple[Situation, NDArray[np.float32]]]:
    """What one vehicle measures early in episodes of all sizes, in range or not, and the tensor it sees there.

    Without a second look that is the start, with one as many random steps behind it as it looks back.
    """
    for number in range(count):
        rng = episode_rng(seed, number)
        n_vehicles, n_obstacles = int(rng.integers(1, 13)), int(rng.integers(0, 6))
        bodies = {"n_vehicles": n_vehicles, "n_obstacles": n_obstacles, "obstacle_motion": "walk"}
        arena = max(scenario.link_range, scenario.detection_range) * rng.uniform(2, 5)
        free = {"arena": arena, "obstacle_arena": arena, "obstacle_starts": None, "sensors": SensorErrors()}
        world = World(scenario.replace(**bodies, **free, max_cycles=max(1, scenario.look_back_steps)))
        sensing = world.sensors.measure(world.reset([rng]))
        situation = _measured_by_first(world, sensing)
        if scenario.look_back:
            before = {f"{name}_before": positions for name, positions in situation.items()}
            (x, y), (cos, sin), heading = world.positions[0, 0], world.frames[0, 0], world.headings[0, 0]
            for _ in range(scenario.look_back_steps):
                actions = rng.uniform(world.action_low, world.action_high, (1, n_vehicles, 2))
                sensing = world.sensors.measure(world.step(actions)[0])
            dx, dy = world.positions[0, 0] - (x, y)
            moved = np.array([cos * dx + sin * dy, cos * dy - sin * dx, world.headings[0, 0] - heading])
            situation = {**_measured_by_first(world, sensing), **before, "moved": moved}
        yield situation, observe(sensing, world.scenario)[0, 0]


def _measured_by_first(world: World, sensing: Sensing) -> Situation:
    """Positions of all bodies in the first vehicle's frame."""
    neighbors, obstacles = (
        found.positions[found.observers == 0]
        for found in (
            find_contacts(world.positions, world.frames, world.positions, np.inf, others=True),
            find_contacts(world.positions, world.frames, world.obstacle_positions, np.inf),
        )
    )
    return {"neighbors": neighbors, "obstacles": obstacles, "waypoint": sensing.waypoint_positions[0, 0]}


@contextlib.contextmanager
def _quiet_exporter() -> Iterator[None]:
    """The exporter of torch tells of its own workings, not of the policy."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
