"""Loading policies from files of strangers: plain values and tensors are read, nothing is ever run.

SB3's own ``load`` unpickles, and so runs whatever code its file holds. :func:`load_policy` rebuilds the networks from the JSON
member that :func:`~sb3_flock.rl.saving.save_model` writes, or from the shapes of the tensors in a file that SB3 alone saved.
"""

from __future__ import annotations

import io
import json
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.rl.algorithms import ALGORITHMS, policy_kwargs
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.ddpg import FlockDDPG
from sb3_flock.rl.extractor import FlockCNN
from sb3_flock.rl.policy import FlockPolicy
from sb3_flock.rl.saving import FORMAT, MEMBER
from sb3_flock.settings import SettingsError, UserError
from sb3_flock.sim import Scenario

_CHECKPOINT = re.compile(r"rl_model_(\d+)_steps\.zip")


class PolicyError(UserError):
    """A policy file cannot be used."""


@dataclass(frozen=True)
class LoadedPolicy:
    """A loaded policy and what its file tells of it."""

    path: Path
    policy: BasePolicy
    config: TrainingConfig
    versions: dict[str, str]
    num_timesteps: int

    @property
    def scenario(self) -> Scenario:
        """The task it was trained for."""
        return self.config.scenario

    def describe(self) -> dict[str, Any]:
        """What a result should tell of it, as plain values."""
        return {
            "policy": str(self.path),
            "algo": self.config.algo,
            "num_timesteps": self.num_timesteps,
            "trained_with": self.versions,
        }

    def check(self, scenario: Scenario) -> None:
        """Whether it can fly in a scenario. Warns where the same tensor or action means something else there.

        :raises PolicyError: if its tensor has another shape
        """
        shape = self.policy.observation_space.shape
        if shape != scenario.observation_shape:
            raise PolicyError(
                f"{self.path}: it sees tensors of {shape}, but the scenario's (n_anchors = {scenario.n_anchors}, "
                f"look_back = {scenario.look_back}) are of {scenario.observation_shape}"
            )
        names = ("link_range", "detection_range", "channel_radii", "anchor_width", "look_back", "max_speed", "max_turn_rate")
        values = [(name, getattr(self.scenario, name), getattr(scenario, name)) for name in names]
        changed = [f"{name} = {trained}, flown with {flown}" for name, trained, flown in values if trained != flown]
        if changed:
            warnings.warn(f"{self.path}: trained with {'; '.join(changed)}", stacklevel=2)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """SB3's ``predict``: tensors ``(vehicles, channels, l, l)`` (or one) to actions ``(vehicles, 2)`` [m/s, rad/s]."""
        return self.policy.predict(observation, state, episode_start, deterministic)


def check_device(device: str) -> None:
    """Whether torch has a device.

    :raises SettingsError: if not
    """
    try:
        th.ones(1, device=None if device == "auto" else device).item()
    except (RuntimeError, AssertionError) as error:  # torch built without CUDA asserts
        raise SettingsError(f"device = {device!r}: {first_line(error)}") from None


def shipped_policies() -> dict[str, Path]:
    """The policies that come with the package, by name; beside each zip lies its model card."""
    return {path.stem: path for path in sorted((Path(__file__).parents[1] / "policies").glob("*.zip"))}


def checkpoint_paths(folder: Path) -> list[Path]:
    """A run folder's checkpoints ``rl_model_<steps>_steps.zip``, oldest first."""
    found = [(_CHECKPOINT.fullmatch(path.name), path) for path in folder.glob("rl_model_*_steps.zip")]
    return [path for _, path in sorted((int(match[1]), path) for match, path in found if match)]


def find_policy(path: str | Path) -> Path:
    """The zip that a path means: itself, a run folder's best (else final, else newest) model, or a shipped policy by name.

    :raises PolicyError: if there is none
    """
    shipped = shipped_policies().get(str(path))
    path = Path(path)
    if shipped is not None and not path.exists():
        return shipped
    if path.is_dir():
        for found in (path / "best_model.zip", path / "final_model.zip", *reversed(checkpoint_paths(path))):
            if found.is_file():
                return found
        raise PolicyError(f"{path}: no best_model.zip, final_model.zip or checkpoint in this folder")
    if not path.is_file():
        raise PolicyError(f"{path}: no such file or run folder, nor one of {', '.join(shipped_policies())}")
    return path


def load_policy(path: str | Path, device: str = "cpu", trust: bool = False) -> LoadedPolicy:
    """Load a policy. No code from the file is run, unless it is trusted; memory and time are bounded by the file's size.

    A file that SB3 alone saved is read if it is DDPG or TD3 with :class:`FlockCNN`; what it does not tell of its task is taken
    to be the default, with a warning.

    :param path: a zip, a run folder (its ``best_model.zip``) or a shipped policy's name
    :param device: torch device
    :param trust: let SB3 load the file, which runs any code in it
    :raises PolicyError: one line for a missing, damaged or foreign file
    :raises SettingsError: for a device that torch does not have
    """
    path = find_policy(path)
    check_device(device)
    torch_device = get_device(device)
    try:
        with zipfile.ZipFile(path) as archive:
            has_member = MEMBER in archive.namelist()
            member = json.loads(read_member(archive, MEMBER, _MOST_JSON)) if has_member else _describe_plain_file(archive)
            weights = {} if trust else read_tensors(archive, "policy.pth", torch_device)
    except _UnknownPartsError as error:
        if not trust:
            raise PolicyError(f"{path}: {error}; trust (--trust) lets SB3 load it, which runs any code in it") from None
        has_member, member, weights = False, {"format": FORMAT, "config": {}}, {}
    except Exception as error:  # zipfile, json and torch raise many kinds for a damaged file; all mean the same here
        raise PolicyError(f"{path}: damaged or not a policy file ({first_line(error)})") from None
    try:
        if member["format"] != FORMAT:
            raise SettingsError(f"format = {member['format']!r}: this version reads {FORMAT}")
        config = TrainingConfig(**member["config"])
        policy = _trusted_policy(path, torch_device) if trust else _rebuild(config, weights, not has_member)
        num_timesteps = int(member.get("num_timesteps", 0))
        trained_with = {str(name): str(number) for name, number in dict(member.get("versions", {})).items()}
    except PolicyError:
        raise
    except (ValueError, KeyError, TypeError, RuntimeError, AttributeError, MemoryError) as error:
        raise PolicyError(f"{path}: its networks do not fit what it says of itself ({first_line(error)})") from None
    if not all(bool(th.isfinite(tensor).all()) for tensor in policy.state_dict().values()):
        raise PolicyError(f"{path}: its weights are not finite")
    if not has_member:
        warnings.warn(f"{path}: saved without its scenario, taken to be the default", stacklevel=2)
    policy.to(torch_device).set_training_mode(False)
    return LoadedPolicy(path, policy, config, trained_with, num_timesteps)


_MOST_JSON = 2**20
_MOST_TENSORS = 2**28
"""Most bytes of a member that is read: 700 times our default networks."""


def read_member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """A member of at most so many bytes; what it unpacks to is bounded, whatever its header says.

    :raises KeyError: if there is none
    :raises ValueError: if it is larger, or packed in an unusual way
    """
    info = archive.getinfo(name)
    if info.file_size > most:
        raise ValueError(f"{name} has {info.file_size} bytes: at most {most} are read")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is packed by another method than deflation")
    with archive.open(info) as file:
        content = file.read(max(1, info.file_size))  # a bare read() would unpack as much as there is
        if len(content) < info.file_size or file.read(1):
            raise ValueError(f"{name} has another size than it says")
    return content


def read_tensors(archive: zipfile.ZipFile, name: str, device: th.device, most: int = _MOST_TENSORS) -> dict[str, Any]:
    """The tensors of a ``.pth`` member, by torch's reader that knows tensors and plain values only.

    :raises ValueError: if the member is none of torch's zips, or too large
    """
    stored = io.BytesIO(read_member(archive, name, most))
    with zipfile.ZipFile(stored) as inner:
        size = sum(info.file_size for info in inner.infolist())
    if size > most:
        raise ValueError(f"{name} holds {size} bytes: at most {most} are read")
    stored.seek(0)
    tensors: dict[str, Any] = th.load(stored, map_location=device, weights_only=True)
    return tensors


def _rebuild(config: TrainingConfig, weights: Mapping[str, Any], actor_only: bool) -> BasePolicy:
    """The policy of a config with these weights, built only if the file holds as many numbers.

    :param actor_only: take the actor's weights alone, all that flying needs
    """
    for tensor in weights.values():
        if not isinstance(tensor, th.Tensor) or tensor.layout != th.strided or tensor.is_meta:
            raise ValueError("policy.pth holds something else than numbers")
    storages = [(tensor.untyped_storage(), tensor.element_size()) for tensor in weights.values()]
    stored = sum({storage.data_ptr(): storage.nbytes() // size for storage, size in storages}.values())
    least = _least_parameters(config)
    if least > stored:
        raise ValueError(f"policy.pth holds {stored} numbers, the networks at least {least}")
    policy = _build_policy(config)
    part: nn.Module = policy
    if actor_only:
        part = policy.get_submodule("actor")
        weights = {name.removeprefix("actor."): tensor for name, tensor in weights.items() if name.startswith("actor.")}
    part.load_state_dict(weights)
    return policy


def _least_parameters(config: TrainingConfig) -> int:
    """Parameters of an actor and its critics, or fewer, counted without building them."""
    network = config.network
    with th.device("meta"):  # shapes without memory
        extractor = FlockCNN(observation_space(config.scenario), **policy_kwargs(config)["features_extractor_kwargs"])
        actor = create_mlp(network.features_dim, 2, list(network.net_arch))
        critic = create_mlp(network.features_dim + network.action_layer, 1, list(network.net_arch))
    count, first, second = (sum(p.numel() for m in part for p in m.parameters()) for part in ([extractor], actor, critic))
    return 2 * count + first + network.n_critics * second


def _build_policy(config: TrainingConfig) -> BasePolicy:
    _, policy_class = ALGORITHMS[config.algo]
    return policy_class(
        observation_space(config.scenario),
        action_space(config.scenario),
        lr_schedule=lambda _: 0.0,
        **{**policy_kwargs(config), "optimizer_kwargs": {}},
    )


def _trusted_policy(path: Path, device: th.device) -> BasePolicy:
    """The policy of whatever algorithm of SB3 reads the file."""
    for algorithm in (FlockDDPG, TD3, SAC, PPO):
        try:
            return algorithm.load(path, device=device).policy
        except Exception as error:  # whatever the file's own code raises
            reason = error
    raise PolicyError(f"{path}: SB3 cannot load it either ({first_line(reason)})")


# -- files that SB3 alone saved --------------------------------------------------------------------------------------


class _UnknownPartsError(ValueError):
    """The tensors' shapes do not tell enough."""


def _describe_plain_file(archive: zipfile.ZipFile) -> dict[str, Any]:
    """What our JSON member would say of a file without one, from the shapes of its tensors and the plain text in ``data``.

    :raises _UnknownPartsError: if they do not tell enough
    """
    try:
        data = json.loads(read_member(archive, "data", _MOST_TENSORS))
        weights = read_tensors(archive, "policy.pth", th.device("cpu"))
        shapes = {name: tuple(tensor.shape) for name, tensor in weights.items()}
        cnn = "actor.features_extractor."
        convolutions = [shapes[name] for name in shapes if re.fullmatch(re.escape(cnn) + r"cnn\.\d+\.weight", name)]
        hidden = [shapes[name][0] for name in shapes if re.fullmatch(r"actor\.mu\.\d+\.weight", name)]
        low, high = (_numbers(data["action_space"][name]) for name in ("low", "high"))
        if low != [0.0, -high[1]]:
            raise ValueError("its actions are not a speed and a turn rate")
        tensor = _tensor_fields(*data["observation_space"]["_shape"])
        ours = data["policy_class"]["__module__"] == FlockPolicy.__module__
        kwargs = data["policy_kwargs"]
        config = {
            "scenario": {"max_speed": high[0], "max_turn_rate": high[1], **tensor},
            "network": {
                "channels": [shape[0] for shape in convolutions],
                "kernel_size": convolutions[0][2],
                "features_dim": shapes[cnn + "dense.0.weight"][0],
                "layer_norm": cnn + "dense.1.weight" in shapes,
                "net_arch": hidden[:-1],
                "action_bound": kwargs.get("action_bound", "inverting") if ours else "tanh",
            },
        }
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        why = f"not a policy of sb3_flock, nor one of DDPG or TD3 with FlockCNN ({first_line(error)})"
        raise _UnknownPartsError(why) from None
    return {"format": FORMAT, "config": config}


def _tensor_fields(channels: int, n_anchors: int, _: int) -> dict[str, Any]:
    """The fields of a scenario with tensors of this shape; a second look is taken to be that of our configs."""
    if channels not in (3, 6):
        raise ValueError(f"its tensors have {channels} channels: 3 or 6 are needed")
    return {"n_anchors": n_anchors, "look_back": 0.0 if channels == 3 else 0.2}


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.strip("[] ").split()]


def first_line(error: Exception) -> str:
    """An error's first line, of a bearable length."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
