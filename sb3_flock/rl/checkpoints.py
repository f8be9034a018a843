"""Checkpoints: everything that decides how a training goes on, in one zip.

``rl_model_<steps>_steps.zip`` is a model as SB3 saves it, with our JSON member (:mod:`sb3_flock.rl.saving`), and beside
them the state of the training: replay buffer, episodes under way, random streams, callbacks. That state is plain values in
``training.json`` and arrays in ``training/*.npy``: reading it runs no code.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import platform
import random
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

from sb3_flock.envs.vec_env import ParameterSharingVecEnv
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.loading import PolicyError, checkpoint_paths, first_line, read_member, read_tensors
from sb3_flock.rl.replay import load_replay_state, replay_state
from sb3_flock.rl.saving import save_model, versions
from sb3_flock.sim.backend import compiled

_VALUES = "training.json"
_ARRAYS = "training/"
_MODEL_STATE = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")
_MOST_BESIDES = 2**28
"""Bytes that anything but the replay buffer may have."""


class Stateful(Protocol):
    """A part of a training that a checkpoint keeps: plain values and arrays, in dicts and lists."""

    def state_dict(self) -> dict[str, Any]:
        """What the part needs to go on."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from there."""


def save_checkpoint(model: OffPolicyAlgorithm, path: Path, config: TrainingConfig, parts: Mapping[str, Stateful]) -> None:
    """Save a model and the state of its training, whole or not at all.

    :param parts: what else has a state, by name
    :raises OSError: if it cannot be written; no part of it is left
    """
    state = {
        "surroundings": surroundings(config),
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
    """A checkpoint in memory, whole and well-formed.

    :param path: the zip
    :param most: bytes that a part of it may unpack to
    :raises PolicyError: one line for a missing, damaged or foreign file
    """

    def __init__(self, path: Path, most: int) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                values = json.loads(read_member(archive, _VALUES, most))
                arrays = {}
                for name in archive.namelist():
                    if name.startswith(_ARRAYS):
                        stored = io.BytesIO(read_member(archive, name, most))
                        key = name.removeprefix(_ARRAYS).removesuffix(".npy")
                        arrays[key] = np.lib.format.read_array(stored, allow_pickle=False)
                self.tensors = {
                    name: read_tensors(archive, name, th.device("cpu"))
                    for name in archive.namelist()
                    if name.endswith(".pth")
                }
            self.state = _put_arrays(values, arrays)
        except Exception as error:  # zipfile, json, NumPy and torch raise many kinds for a damaged file
            raise PolicyError(f"{path}: damaged or not a checkpoint ({first_line(error)})") from None

    @property
    def num_timesteps(self) -> int:
        """Transitions flown when it was saved."""
        return int(self.state["model"]["num_timesteps"])

    @property
    def surroundings(self) -> dict[str, str]:
        """The :func:`surroundings` in which it was saved."""
        return dict(self.state["surroundings"])

    def restore_model(self, model: OffPolicyAlgorithm) -> None:
        """Set the networks, the optimizers, the replay buffer and the episodes under way.

        :raises PolicyError: if they are not those of this config
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
        """Set the callbacks and, last of all, the random streams.

        :raises PolicyError: if they are not those of this config
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


def newest_checkpoint(
    folder: Path, config: TrainingConfig, tell: Callable[[str], None] = lambda line: None
) -> LoadedCheckpoint | None:
    """The newest whole checkpoint of a run folder, or ``None``.

    :param config: the run's config, which bounds what is read
    :param tell: called with one line about each damaged one that is passed over
    """
    pixels = math.prod(config.scenario.observation_shape)
    slots = config.n_flocks * sum(scenario.n_vehicles for scenario in config.flown_scenarios())
    most = _MOST_BESIDES + 4 * (2 * pixels + 16) * (config.learner.buffer_size + 2 * slots)
    for path in reversed(checkpoint_paths(folder)):
        try:
            return LoadedCheckpoint(path, most)
        except PolicyError as error:
            tell(f"passed over {error}")
    return None


def inexactness(checkpoint: LoadedCheckpoint | None, config: TrainingConfig) -> str:
    """Why a resumed run will not be the same to the last bit, as the end of a line; empty if it will."""
    if checkpoint is None:
        return ""
    then, now = checkpoint.surroundings, surroundings(config)
    reasons = [
        f"{name} {then.get(name)} then, {now.get(name)} now" for name in {**then, **now} if then.get(name) != now.get(name)
    ]
    if now["device"] != "cpu" or now["threads"] != "1":
        reasons.append("exact only on the CPU with one thread")
    if config.num_cpus > 1:
        reasons.append("workers start new episodes")
    return f"; not bit-exact: {', '.join(reasons)}" if reasons else ""


def surroundings(config: TrainingConfig) -> dict[str, str]:
    """What the last bits of a training depend on besides its config."""
    return {
        **versions(),
        "numba": version("numba") if compiled() else "none",
        "machine": f"{platform.system()} {platform.machine()} {th.backends.cpu.get_cpu_capability()}",
        "device": get_device(config.device).type,
        "threads": str(th.get_num_threads()),
    }


class RandomStreams:
    """Every random stream of a training, but for those of the flocks."""

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
        **{name: getattr(model, name) for name in _MODEL_STATE},
        "episodes": list(model.ep_info_buffer or ()),
        "last_observations": model._last_obs,
        "env": _flocks(model).state_dict(),
        "returns": _monitor(model).episode_returns,
        "lengths": _monitor(model).episode_lengths,
        "replay": replay_state(model.replay_buffer),
    }


def _load_model_state(model: OffPolicyAlgorithm, state: Mapping[str, Any]) -> None:
    assert model.replay_buffer is not None
    for name in _MODEL_STATE:
        setattr(model, name, state[name])
    model.ep_info_buffer = deque(state["episodes"], maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)  # this task has no successes in its infos
    load_replay_state(model.replay_buffer, state["replay"])
    env = _flocks(model)
    if state["env"] is None:  # kept by workers, out of reach: new episodes, not those of the start again
        env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
        model._last_obs = _monitor(model).reset()  # type: ignore[assignment]
    else:
        env.load_state_dict(state["env"])
        model._last_obs = state["last_observations"]
        _monitor(model).episode_returns[:] = state["returns"]
        _monitor(model).episode_lengths[:] = state["lengths"]
    model._last_episode_starts = np.zeros(model.n_envs, dtype=bool)


def _monitor(model: OffPolicyAlgorithm) -> VecMonitor:
    assert isinstance(model.env, VecMonitor)  # train() builds it so
    return model.env


def _flocks(model: OffPolicyAlgorithm) -> ParameterSharingVecEnv:
    venv = _monitor(model).venv
    assert isinstance(venv, ParameterSharingVecEnv)
    return venv


def _take_arrays(tree: Any, name: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """The tree as JSON knows it; its arrays go to ``arrays`` and leave their names."""
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
