"""Checkpoints: everything that a training depends on when it continues, in one zip.

``rl_model_<steps>_steps.zip`` is a model as SB3 saves it, with our JSON member (:mod:`sb3_flock.serialization.save`), and the
state of the training: replay buffer, current episodes, random streams, callbacks. That state is plain values in
``training.json`` and arrays in ``training/*.npy``: reading it runs no code.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import platform
import random
import re
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecMonitor

from sb3_flock._compat import begin_at, counters, last_observations, set_counters
from sb3_flock.config.training import TrainingConfig
from sb3_flock.envs.vec_env import ParameterSharingVecEnv
from sb3_flock.rl.buffers import load_replay_state, replay_state
from sb3_flock.rl.compiled_update import compiled_kernels
from sb3_flock.rl.ddpg import FlockTD3
from sb3_flock.rl.registry import ALGORITHMS, uses_compact_buffer
from sb3_flock.serialization.archive import check_size, read_member
from sb3_flock.serialization.load import PolicyError, checkpoint_paths, read_tensors
from sb3_flock.serialization.migrate import MEMBER, check_format, migrate_config, migrate_state
from sb3_flock.serialization.save import save_model, versions
from sb3_flock.settings import first_line
from sb3_flock.sim.backend import compiled
from sb3_flock.training.checkpoint_schema import check_state

_VALUES = "training.json"
_ARRAYS = "training/"
_MAX_WITHOUT_REPLAY = 2**28
"""Largest number of bytes of everything but the replay buffer."""


class Stateful(Protocol):
    """A part of a training that a checkpoint keeps: plain values and arrays, in dicts and lists."""

    def state_dict(self) -> dict[str, Any]:
        """What the part needs to continue."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""


def save_checkpoint(model: OffPolicyAlgorithm, path: Path, config: TrainingConfig, parts: Mapping[str, Stateful]) -> None:
    """Save a model and the state of its training, whole or not at all.

    :param parts: further parts with a state, by name
    :raises OSError: if it cannot be written; nothing of it is left
    """
    state = {
        "runtime_info": runtime_info(config),
        "model": _model_state(model),
        "parts": {name: part.state_dict() for name, part in parts.items()},
    }
    arrays: dict[str, NDArray[Any]] = {}
    values = json.dumps(_take_arrays(state, "", arrays))

    def write(archive: zipfile.ZipFile) -> None:
        archive.writestr(_VALUES, values)
        for name, array in arrays.items():
            with archive.open(f"{_ARRAYS}{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)

    save_model(model, path, config, extra=write)


class LoadedCheckpoint:
    """A checkpoint in memory, whole and well-formed; ``config`` is the one of the training that saved it.

    :param path: the zip
    :param limit: largest number of bytes that it may unpack to
    :raises PolicyError: one line for a missing, damaged or unknown file
    """

    def __init__(self, path: Path, limit: int) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                check_size(archive, limit)
                values = json.loads(read_member(archive, _VALUES, limit))
                arrays = {}
                for name in archive.namelist():
                    if name.startswith(_ARRAYS):
                        stored = io.BytesIO(read_member(archive, name, limit))
                        key = name.removeprefix(_ARRAYS).removesuffix(".npy")
                        arrays[key] = np.lib.format.read_array(stored, allow_pickle=False)
                self.tensors = {
                    name: read_tensors(archive, name, th.device("cpu"))
                    for name in archive.namelist()
                    if name.endswith(".pth")
                }
                member = json.loads(read_member(archive, MEMBER, limit))
            number = check_format(member["format"])
            self.config = TrainingConfig(**migrate_config(TrainingConfig, member["config"], number)[0])
            self.state = migrate_state(_put_arrays(values, arrays), number)
            check_state(self.state)
        except Exception as error:  # zipfile, json, NumPy and torch raise many kinds for a damaged file
            raise PolicyError(f"{path}: damaged or not a checkpoint ({first_line(error)})") from None

    @property
    def num_timesteps(self) -> int:
        """Transitions of the training when it was saved."""
        number: int = self.state["model"]["num_timesteps"]
        return number

    @property
    def runtime_info(self) -> dict[str, str]:
        """The :func:`runtime_info` with which it was saved."""
        return dict(self.state["runtime_info"])

    def restore_model(self, model: OffPolicyAlgorithm) -> None:
        """Restore the networks, the optimizers, the replay buffer and the current episodes.

        :raises PolicyError: if they do not fit the model
        """
        with self._fitting():
            self._restore_model(model)

    def _restore_model(self, model: OffPolicyAlgorithm) -> None:
        parameters = {name.removesuffix(".pth"): tensors for name, tensors in self.tensors.items()}
        for name, value in (parameters.pop("pytorch_variables", None) or {}).items():  # SAC's entropy coefficient
            getattr(model, name).data.copy_(value)
        model.set_parameters(parameters, exact_match=True, device=model.device)  # type: ignore[arg-type]
        _load_model_state(model, self.state["model"])

    def restore_parts(self, parts: Mapping[str, Stateful]) -> None:
        """Restore the callbacks and, last, the random streams.

        :raises PolicyError: if they do not fit the parts
        """
        with self._fitting():
            for name, part in parts.items():
                part.load_state_dict(self.state["parts"][name])

    @contextlib.contextmanager
    def _fitting(self) -> Iterator[None]:
        try:
            yield
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError) as error:
            raise PolicyError(f"{self.path}: not a checkpoint of this run's config ({first_line(error)})") from None


def whole_checkpoints(folder: Path, config: TrainingConfig, report: Callable[[str], None]) -> Iterator[LoadedCheckpoint]:
    """The whole checkpoints of a run folder, newest first.

    :param config: the run's config, which bounds the size of what is read
    :param report: called with one line about each damaged checkpoint, which is skipped
    """
    pixels = math.prod(config.scenario.observation_shape)
    slots = config.n_flocks * sum(scenario.n_vehicles for scenario in config.training_scenarios())
    limit = _MAX_WITHOUT_REPLAY + 4 * (2 * pixels + 16) * (config.algorithm.buffer_size + 2 * slots)
    for path in reversed(checkpoint_paths(folder)):
        try:
            yield LoadedCheckpoint(path, limit)
        except PolicyError as error:
            report(f"skipped {error}")


def reproducibility_warnings(checkpoint: LoadedCheckpoint | None, config: TrainingConfig) -> str:
    """Why a resumed training will not equal an uninterrupted one to the last bit, as the end of a line; empty if it will."""
    if checkpoint is None:
        return ""
    then, now = checkpoint.runtime_info, runtime_info(config)
    reasons = [
        f"{name} {then.get(name)} then, {now.get(name)} now" for name in {**then, **now} if then.get(name) != now.get(name)
    ]
    if now["device"] != "cpu" or now["threads"] != "1":
        reasons.append("exact only on the CPU with one thread")
    if config.num_cpus > 1:
        reasons.append("worker processes start new episodes")
    return f"; not bit-exact: {', '.join(reasons)}" if reasons else ""


def runtime_info(config: TrainingConfig) -> dict[str, str]:
    """What the last bits of a training depend on besides its config: versions, machine, device, threads."""
    return {
        **versions(),
        "numba": version("numba") if compiled() else "none",
        "machine": f"{platform.system()} {platform.machine()} {th.backends.cpu.get_cpu_capability()}",
        "processor": _processor(),
        "update": _update(config),
        "device": get_device(config.device).type,
        "threads": str(th.get_num_threads()),
    }


def _update(config: TrainingConfig) -> str:
    """What code updates the networks."""
    algorithm, _ = ALGORITHMS[config.algo].load()
    is_compiled = issubclass(algorithm, FlockTD3) and uses_compact_buffer(config) and compiled_kernels()
    return "compiled" if is_compiled and config.device == "cpu" else "torch"


def _processor() -> str:
    """Vendor, family and model of the processor: libraries of linear algebra choose their code, and so their rounding, by it."""
    names = "vendor_id|cpu family|model|CPU implementer|CPU part"
    try:
        fields = dict(re.findall(rf"^({names})\s*: (.+)$", Path("/proc/cpuinfo").read_text("utf-8"), re.MULTILINE))
    except OSError:
        fields = {}
    return " ".join(fields.values()) or platform.processor()


class RandomStreams:
    """Every random stream of a training except those of the envs."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self.actions = model.action_space.np_random.bit_generator

    def state_dict(self) -> dict[str, Any]:
        form, numbers, gauss = random.getstate()
        kind, keys, position, has_gauss, cached = np.random.get_state()  # noqa: NPY002 - what SB3 draws from
        state = {
            "python": [form, list(numbers), gauss],
            "numpy": [kind, keys, position, has_gauss, cached],
            "torch": th.get_rng_state().numpy(),
            "actions": self.actions.state,
        }
        if th.cuda.is_available():
            state["cuda"] = [device.numpy() for device in th.cuda.get_rng_state_all()]
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        form, numbers, gauss = state["python"]
        random.setstate((form, tuple(numbers), gauss))
        np.random.set_state(tuple(state["numpy"]))  # noqa: NPY002
        th.set_rng_state(th.from_numpy(state["torch"]))
        self.actions.state = state["actions"]
        if th.cuda.is_available() and len(state.get("cuda", ())) == th.cuda.device_count():
            th.cuda.set_rng_state_all([th.from_numpy(device) for device in state["cuda"]])


def _model_state(model: OffPolicyAlgorithm) -> dict[str, Any]:
    assert model.replay_buffer is not None
    return {
        "num_timesteps": model.num_timesteps,
        **counters(model),
        "episodes": list(model.ep_info_buffer or ()),
        "last_observations": last_observations(model),
        "env": _flocks(model).state_dict(),
        "returns": _monitor(model).episode_returns,
        "lengths": _monitor(model).episode_lengths,
        "replay": replay_state(model.replay_buffer),
    }


def _load_model_state(model: OffPolicyAlgorithm, state: Mapping[str, Any]) -> None:
    assert model.replay_buffer is not None
    model.num_timesteps = state["num_timesteps"]
    set_counters(model, state)
    load_replay_state(model.replay_buffer, state["replay"])
    env = _flocks(model)
    if state["env"] is None:  # the workers' episodes cannot be saved: start new ones, not those of the start again
        env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
        observations = _monitor(model).reset()
    else:
        env.load_state_dict(state["env"])
        observations = state["last_observations"]
        _monitor(model).episode_returns[:] = state["returns"]
        _monitor(model).episode_lengths[:] = state["lengths"]
    begin_at(model, observations, state["episodes"])


def _monitor(model: OffPolicyAlgorithm) -> VecMonitor:
    assert isinstance(model.env, VecMonitor)  # train() builds it so
    return model.env


def _flocks(model: OffPolicyAlgorithm) -> ParameterSharingVecEnv:
    venv = _monitor(model).venv
    assert isinstance(venv, ParameterSharingVecEnv)
    return venv


def _take_arrays(tree: Any, name: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """The tree in JSON's types; its arrays are moved to ``arrays``, and their names stand in their place."""
    if isinstance(tree, np.ndarray):
        arrays[name] = tree
        return {"array": name}
    if isinstance(tree, Mapping):
        return {key: _take_arrays(value, f"{name}.{key}" if name else key, arrays) for key, value in tree.items()}
    if isinstance(tree, list | tuple | deque):
        return [_take_arrays(value, f"{name}.{i}", arrays) for i, value in enumerate(tree)]
    return tree.item() if isinstance(tree, np.generic) else tree


def _put_arrays(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """The inverse of :func:`_take_arrays`."""
    if isinstance(tree, dict):
        if set(tree) == {"array"}:
            return arrays[tree["array"]]
        return {key: _put_arrays(value, arrays) for key, value in tree.items()}
    return [_put_arrays(value, arrays) for value in tree] if isinstance(tree, list) else tree
