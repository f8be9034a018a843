"""Loading policies from untrusted files: only plain values and tensors are read, no code from the file is run.

SB3's own ``load`` unpickles, and so runs any code in its file. :func:`load_policy` rebuilds the networks from the JSON member
that :func:`~sb3_flock.serialization.save.save_model` writes, or from the shapes of the tensors in a file that SB3 alone saved.
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
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_wrapper
from torch import nn

from sb3_flock._renamed import current_policy
from sb3_flock.config.training import TrainingConfig
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.pretrained import shipped_policies
from sb3_flock.rl.ddpg import FlockDDPG
from sb3_flock.rl.registry import ALGORITHMS, build_model, fewest_parameters, policy_kwargs
from sb3_flock.serialization.archive import check_size, read_member
from sb3_flock.serialization.migrate import FORMAT, MEMBER, check_format, migrate_config, migrate_weights
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import SettingsError, UserError, first_line, format_value
from sb3_flock.sim import Scenario, check_actions

_CHECKPOINT = re.compile(r"rl_model_(\d+)_steps\.zip")

_UNFILTERED = {"safety_filter": "off", "shared_detections": False}
"""What is assumed of the task of a file that SB3 alone saved: the paper's, not that of a training of ours."""


class PolicyError(UserError):
    """A policy file cannot be used."""


@dataclass(frozen=True)
class LoadedPolicy:
    """A loaded policy, and what its file says about it."""

    path: Path
    policy: BasePolicy
    config: TrainingConfig
    versions: dict[str, str]
    num_timesteps: int
    has_config: bool = True
    """Whether the file holds the config; otherwise a default one is assumed, with networks as far as the tensors show them."""

    @property
    def scenario(self) -> Scenario:
        """The task it was trained for."""
        return self.config.scenario

    def describe(self) -> dict[str, Any]:
        """What a result should record about the policy, as plain values."""
        return {
            "policy": str(self.path),
            "algo": self.config.algo,
            "num_timesteps": self.num_timesteps,
            "trained_with": self.versions,
        }

    def check(self, scenario: Scenario) -> None:
        """Check that the policy fits a scenario. It warns where the same observation or action has another meaning there.

        :raises PolicyError: if the observations differ in shape
        """
        shape = self.policy.observation_space.shape
        if shape != scenario.observation_shape:
            raise PolicyError(
                f"{self.path}: its observations have the shape {shape}, the scenario's (n_anchors = {scenario.n_anchors}, "
                f"motion_lag = {scenario.motion_lag}) have {scenario.observation_shape}"
            )
        names = (
            "link_range",
            "detection_range",
            "shared_detections",
            "channel_radii",
            "extra_channels",
            "anchor_width",
            "motion_lag",
            "max_speed",
            "max_turn_rate",
        )
        values = [(name, getattr(self.scenario, name), getattr(scenario, name)) for name in names]
        changed = [f"{name} = {trained}, evaluated with {here}" for name, trained, here in values if trained != here]
        if changed:
            warnings.warn(f"{self.path}: trained with {'; '.join(changed)}", stacklevel=2)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """SB3's ``predict``: observations ``(vehicles, channels, l, l)`` (or one) to actions ``(vehicles, 2)`` [m/s, rad/s].

        :raises ActionError: if an action is not finite
        """
        actions, state = self.policy.predict(observation, state, episode_start, deterministic)
        check_actions(actions, actions.shape, *["vehicle"] * (actions.ndim - 1))
        return actions, state

    def to_model(self, env: VecEnv, **changes: Any) -> OffPolicyAlgorithm:
        """A model with these networks that learns on in an env, with the algorithm and the parameters that trained the policy.

        The exploration noise, the number of updates a step and the learning rate's schedule start anew for this env. Behavior
        cloning (``bc_coef``) stays where the env's expert is queried in every step
        (:class:`~sb3_flock.envs.expert_env.ExpertEnv`), and is 0 elsewhere. The optimizers and the replay buffer are empty; the
        first ``learning_starts`` actions are random.

        :param env: the vector env, with any number of slots
        :param changes: parameters of the training by name, such as ``learning_rate`` or ``learning_starts``
        :raises PolicyError: if the file holds no config of its networks, or the policy does not fit the env
        :raises SettingsError: for an unknown parameter or a value that is not accepted
        """
        if not self.has_config:
            raise PolicyError(f"{self.path}: saved without a config of its networks; SB3's own load reads it")
        if (
            env.observation_space.shape != self.policy.observation_space.shape
            or env.action_space != self.policy.action_space
        ):
            raise PolicyError(
                f"{self.path}: its observations of shape {self.policy.observation_space.shape} and actions in "
                f"{self.policy.action_space} are not the env's: {env.observation_space.shape} and {env.action_space}"
            )
        normalize = unwrap_vec_wrapper(env, VecNormalize)
        if normalize is not None and normalize.norm_obs:
            raise PolicyError(f"{self.path}: it was trained without VecNormalize, whose norm_obs=False is needed")
        for scenario in _attributes(env, "scenario")[:1]:
            self.check(scenario)
        if not any(_attributes(env, "queries")):
            changes = {"bc_coef": 0.0, **changes}
        config = load_config(TrainingConfig, overrides={"device": str(self.policy.device), **changes}, base=self.config)
        if (config.algo, config.network) != (self.config.algo, self.config.network):
            raise SettingsError("to_model: algo and the networks are those of the file and cannot change")
        model = build_model(config, env)
        model.policy.load_state_dict(self.policy.state_dict())
        return model


def _attributes(env: VecEnv, name: str) -> list[Any]:
    """An attribute of each slot's env; empty where there is none, or workers hold the envs."""
    try:
        return env.get_attr(name)
    except (AttributeError, NotImplementedError):
        return []


def check_device(device: str) -> None:
    """Check that torch has a device.

    :raises SettingsError: if it has not
    """
    try:
        th.ones(1, device=None if device == "auto" else device).item()
    except (RuntimeError, AssertionError) as error:  # torch built without CUDA asserts
        raise SettingsError(f"device = {device!r}: {first_line(error)}") from None


def checkpoint_paths(folder: Path) -> list[Path]:
    """A run folder's checkpoints ``rl_model_<steps>_steps.zip``, oldest first."""
    found = [(_CHECKPOINT.fullmatch(path.name), path) for path in folder.glob("rl_model_*_steps.zip")]
    return [path for _, path in sorted((int(match[1]), path) for match, path in found if match)]


def find_policy(path: str | Path) -> Path:
    """The zip for a path: the path itself, a run folder's best (else final, else newest) model, or a shipped policy by name.

    :raises PolicyError: if there is none
    """
    if not Path(path).exists():
        path = current_policy(str(path), stacklevel=3)
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

    A file that SB3 alone saved is read if it is DDPG or TD3 with :class:`FlockCNN`; the rest of its task is assumed to be the
    default, with a warning. Files of every earlier format are migrated.

    :param path: a zip, a run folder (its ``best_model.zip``) or a shipped policy's name
    :param device: torch device
    :param trust: let SB3 load the file, which runs any code in it
    :raises PolicyError: one line for a missing, damaged or unknown file
    :raises SettingsError: for a device that torch does not have
    """
    path = find_policy(path)
    check_device(device)
    torch_device = get_device(device)
    try:
        with zipfile.ZipFile(path) as archive:
            has_member = MEMBER in archive.namelist()
            member = json.loads(read_member(archive, MEMBER, _MAX_JSON)) if has_member else _describe_plain_file(archive)
            weights = {} if trust else read_tensors(archive, "policy.pth", torch_device)
    except _UnknownPartsError as error:
        if not trust:
            raise PolicyError(f"{path}: {error}; with trust, SB3 loads it and runs any code in it") from None
        has_member, member, weights = False, {"format": FORMAT, "config": {"scenario": _UNFILTERED}}, {}
    except Exception as error:  # zipfile, json and torch raise many kinds for a damaged file; all mean the same here
        raise PolicyError(f"{path}: damaged or not a policy file ({first_line(error)})") from None
    try:
        number = check_format(member["format"])
        values, _ = migrate_config(TrainingConfig, member["config"], number)
        config, weights = TrainingConfig(**values), migrate_weights(weights, number)
        policy = _trusted_policy(path, torch_device) if trust else _rebuild(config, weights, not has_member)
        num_timesteps = member.get("num_timesteps", 0)
        if type(num_timesteps) is not int or num_timesteps < 0:
            raise PolicyError(f"{path}: num_timesteps = {format_value(num_timesteps)}: a number of transitions is needed")
        trained_with = {str(name): str(number) for name, number in dict(member.get("versions", {})).items()}
    except PolicyError:
        raise
    except (ValueError, KeyError, TypeError, RuntimeError, AttributeError, MemoryError) as error:
        raise PolicyError(f"{path}: its networks do not fit its config ({first_line(error)})") from None
    if not all(bool(th.isfinite(tensor).all()) for tensor in policy.state_dict().values()):
        raise PolicyError(f"{path}: its weights are not finite")
    if not has_member:
        warnings.warn(f"{path}: saved without its scenario; the default is assumed", stacklevel=2)
    policy.to(torch_device).set_training_mode(False)
    return LoadedPolicy(path, policy, config, trained_with, num_timesteps, has_member)


_MAX_JSON = 2**20
_MAX_TENSORS = 2**28
"""Largest number of bytes of a member: 700 times our default networks."""


def read_tensors(archive: zipfile.ZipFile, name: str, device: th.device, limit: int = _MAX_TENSORS) -> dict[str, Any]:
    """The tensors of a ``.pth`` member, by torch's reader that knows tensors and plain values only.

    :raises ValueError: if the member is none of torch's zips, or too large
    """
    stored = io.BytesIO(read_member(archive, name, limit))
    with zipfile.ZipFile(stored) as inner:
        check_size(inner, stored.getbuffer().nbytes)  # torch packs nothing
    stored.seek(0)
    tensors: dict[str, Any] = th.load(stored, map_location=device, weights_only=True)
    return tensors


def _rebuild(config: TrainingConfig, weights: Mapping[str, Any], actor_only: bool) -> BasePolicy:
    """The policy of a config with these weights, built only if the file holds enough numbers.

    :param actor_only: load the actor's weights alone, which inference needs
    """
    for tensor in weights.values():
        if not isinstance(tensor, th.Tensor) or tensor.layout != th.strided or tensor.is_meta:
            raise ValueError("policy.pth holds more than plain tensors")
    storages = [(tensor.untyped_storage(), tensor.element_size()) for tensor in weights.values()]
    stored = sum({storage.data_ptr(): storage.nbytes() // size for storage, size in storages}.values())
    needed = fewest_parameters(config, config.scenario.observation_shape)
    if needed > stored:
        raise ValueError(f"policy.pth holds {stored} numbers, the networks at least {needed}")
    policy = build_policy(config)
    part: nn.Module = policy
    if actor_only:
        part = policy.get_submodule("actor")
        weights = {name.removeprefix("actor."): tensor for name, tensor in weights.items() if name.startswith("actor.")}
    part.load_state_dict(weights)
    return policy


class _NoOptimizer:
    """Stands for the optimizers of a policy that is not trained; torch's own would import its compiler, for a second."""

    def __init__(self, *_: Any, **__: Any) -> None:
        """Takes what an optimizer takes."""


def build_policy(config: TrainingConfig) -> BasePolicy:
    """The untrained policy of a config, for inference: without optimizers."""
    _, policy_class = ALGORITHMS[config.algo].load()
    policy = policy_class(
        observation_space(config.scenario),
        action_space(config.scenario),
        lr_schedule=lambda _: 0.0,
        **{**policy_kwargs(config), "optimizer_class": _NoOptimizer},
    )
    policy.optimizer_class = th.optim.Adam  # of a copy that is saved and loaded by SB3
    return policy


def _trusted_policy(path: Path, device: th.device) -> BasePolicy:
    """The policy of whatever algorithm of SB3 reads the file."""
    for algorithm in (FlockDDPG, TD3, SAC, PPO):
        try:
            return algorithm.load(path, device=device).policy
        except Exception as error:  # whatever the file's own code raises
            reason = error
    raise PolicyError(f"{path}: SB3 cannot load it either ({first_line(reason)})")


class _UnknownPartsError(ValueError):
    """The tensors' shapes do not determine the networks."""


def _describe_plain_file(archive: zipfile.ZipFile) -> dict[str, Any]:
    """The JSON member for a file without one, from the shapes of its tensors and the plain text in ``data``.

    :raises _UnknownPartsError: if they do not determine the networks
    """
    try:
        data = json.loads(read_member(archive, "data", _MAX_TENSORS))
        weights = read_tensors(archive, "policy.pth", th.device("cpu"))
        shapes = {name: tuple(tensor.shape) for name, tensor in weights.items()}
        cnn = "actor.features_extractor."
        convolutions = [shapes[name] for name in shapes if re.fullmatch(re.escape(cnn) + r"cnn\.\d+\.weight", name)]
        hidden = [shapes[name][0] for name in shapes if re.fullmatch(r"actor\.mu\.\d+\.weight", name)]
        low, high = (_numbers(data["action_space"][name]) for name in ("low", "high"))
        if low != [0.0, -high[1]]:
            raise ValueError("its actions are not a speed and a turn rate")
        observation = _observation_fields(*data["observation_space"]["_shape"])
        ours = data["policy_class"]["__module__"].startswith("sb3_flock.")
        kwargs = data["policy_kwargs"]
        config = {
            "scenario": {**_UNFILTERED, "max_speed": high[0], "max_turn_rate": high[1], **observation},
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


def _observation_fields(channels: int, n_anchors: int, _: int) -> dict[str, Any]:
    """The fields of a scenario with observations of this shape; ``motion_lag`` is assumed to be that of our configs."""
    if channels not in (3, 6):
        raise ValueError(f"its observations have {channels} channels: 3 or 6 are needed")
    return {"n_anchors": n_anchors, "motion_lag": 0.0 if channels == 3 else 0.2}


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.strip("[] ").split()]
