"""Saved policies: SB3's zip plus one JSON member, ``flock.json``, that tells the task, the learner and the versions.

SB3 ignores the member, so ``DDPG.load`` reads our files as any other. :func:`load_policy` reads no pickle: it rebuilds the
networks from the member's plain values and loads the tensors alone.
"""

from __future__ import annotations

import json
import operator
import os
import platform
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.rl.algorithms import ALGORITHMS, policy_kwargs
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.settings import SettingsError, UserError
from sb3_flock.sim import Scenario

MEMBER = "flock.json"
FORMAT = 2
"""Version of the member's layout and of the networks' (2: the features are flattened anchor by anchor)."""
PACKAGES = ("sb3_flock", "stable_baselines3", "torch", "gymnasium", "pettingzoo", "supersuit", "numpy")
_EPISODE_STATE = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""What SB3 would save of the episodes under way, as large as the networks; a loaded model resets its env before it learns."""


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
        if scenario.n_anchors != self.scenario.n_anchors:
            raise PolicyError(
                f"{self.path}: it sees {self.scenario.n_anchors} anchors a side, but the scenario has {scenario.n_anchors}"
            )
        names = ("link_range", "detection_range", "channel_radii", "anchor_width", "max_speed", "max_turn_rate")
        values = [(name, getattr(self.scenario, name), getattr(scenario, name)) for name in names]
        changed = [f"{name} = {trained}, flown with {flown}" for name, trained, flown in values if trained != flown]
        if changed:
            warnings.warn(f"{self.path}: trained with {'; '.join(changed)}", stacklevel=2)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """SB3's ``predict``: tensors ``(vehicles, 3, l, l)`` (or one) to actions ``(vehicles, 2)`` [m/s, rad/s]."""
        return self.policy.predict(observation, state, episode_start, deterministic)


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that decide a run."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def save_model(model: BaseAlgorithm, path: str | Path, config: TrainingConfig, optimizers: bool = True) -> Path:
    """Save a model as SB3 does, with the JSON member, whole or not at all.

    :param path: the zip to write
    :param optimizers: keep what the optimizers have gathered, which more training needs and flying does not; without it the
        file is less than half as large
    :return: the path
    """
    path = Path(path)
    aside = path.with_name(f".{path.name}.tmp")
    with open(aside, "wb") as file, nullcontext() if optimizers else _fresh_optimizers(model):
        model.save(file, exclude=_EPISODE_STATE)
    member = {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "num_timesteps": model.num_timesteps,
        "versions": versions(),
    }
    with zipfile.ZipFile(aside, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(MEMBER, json.dumps(member, indent=1))
    with open(aside, "rb") as file:
        os.fsync(file.fileno())
    os.replace(aside, path)
    return path


@contextmanager
def _fresh_optimizers(model: BaseAlgorithm) -> Iterator[None]:
    """Optimizers as new while it lasts."""
    found = [operator.attrgetter(name)(model) for name in model._get_torch_save_params()[0] if name.endswith("optimizer")]
    states = [optimizer.state for optimizer in found]
    for optimizer in found:
        optimizer.state = defaultdict(dict)
    try:
        yield
    finally:
        for optimizer, state in zip(found, states, strict=True):
            optimizer.state = state


def check_device(device: str) -> None:
    """Whether torch has a device.

    :raises SettingsError: if not
    """
    try:
        th.ones(1, device=None if device == "auto" else device).item()
    except (RuntimeError, AssertionError) as error:  # torch built without CUDA asserts
        raise SettingsError(f"device = {device!r}: {_first_line(error)}") from None


def shipped_policies() -> dict[str, Path]:
    """The policies that come with the package, by name; beside each zip lies its model card."""
    return {path.stem: path for path in sorted((Path(__file__).parents[1] / "policies").glob("*.zip"))}


def find_policy(path: str | Path) -> Path:
    """The zip that a path means: itself, a run folder's best (else final) model, or a shipped policy by name.

    :raises PolicyError: if there is none
    """
    shipped = shipped_policies().get(str(path))
    path = Path(path)
    if shipped is not None and not path.exists():
        return shipped
    if path.is_dir():
        for name in ("best_model.zip", "final_model.zip"):
            if (path / name).is_file():
                return path / name
        raise PolicyError(f"{path}: no best_model.zip or final_model.zip in this folder")
    if not path.is_file():
        raise PolicyError(f"{path}: no such file or run folder, nor one of {', '.join(shipped_policies())}")
    return path


def load_policy(path: str | Path, device: str = "cpu") -> LoadedPolicy:
    """Load a policy saved by a training run. No code from the file is run.

    :param path: a zip or a run folder (its ``best_model.zip``)
    :param device: torch device
    :raises PolicyError: one line for a missing, damaged or foreign file
    :raises SettingsError: for a device that torch does not have
    """
    path = find_policy(path)
    check_device(device)
    torch_device = get_device(device)
    try:
        with zipfile.ZipFile(path) as archive:
            member = json.loads(archive.read(MEMBER))
            with archive.open("policy.pth") as file:
                weights = th.load(file, map_location=torch_device, weights_only=True)
    except KeyError as error:
        raise PolicyError(f"{path}: not a policy of sb3_flock ({_first_line(error)})") from None
    except Exception as error:  # zipfile, json and torch raise many kinds for a damaged file; all mean the same here
        raise PolicyError(f"{path}: damaged or not a policy file ({_first_line(error)})") from None
    try:
        if member["format"] != FORMAT:
            raise SettingsError(f"format = {member['format']!r}: this version reads {FORMAT}")
        config = TrainingConfig(**member["config"])
        policy = _build_policy(config)
        policy.load_state_dict(weights)
    except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        raise PolicyError(f"{path}: its networks do not fit what it says of itself ({_first_line(error)})") from None
    if not all(bool(th.isfinite(tensor).all()) for tensor in policy.state_dict().values()):
        raise PolicyError(f"{path}: its weights are not finite")
    policy.to(torch_device).set_training_mode(False)
    return LoadedPolicy(path, policy, config, member.get("versions", {}), member.get("num_timesteps", 0))


def _build_policy(config: TrainingConfig) -> BasePolicy:
    _, policy_class = ALGORITHMS[config.algo]
    return policy_class(
        observation_space(config.scenario),
        action_space(config.scenario),
        lr_schedule=lambda _: 0.0,
        **policy_kwargs(config),
    )


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
