"""Saved policies: SB3's zip plus one JSON member, ``flock.json``, with the format, the config and the versions.

SB3 ignores the member, so ``DDPG.load`` reads our files as any other. :mod:`sb3_flock.serialization.load` reads no pickle: it
rebuilds the networks from the member's plain values and loads the tensors alone.
"""

from __future__ import annotations

import json
import os
import platform
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy

from sb3_flock._compat import EPISODE_STATE, optimizers_of
from sb3_flock.config.training import TrainingConfig
from sb3_flock.rl.registry import policy_kwargs
from sb3_flock.rl.settings import NetworkConfig
from sb3_flock.serialization.archive import check_clock
from sb3_flock.serialization.load import build_policy
from sb3_flock.serialization.migrate import FORMAT, MEMBER
from sb3_flock.settings import SettingsError

PACKAGES = ("sb3_flock", "stable_baselines3", "torch", "gymnasium", "pettingzoo", "supersuit", "numpy")


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that a training depends on."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def save_model(
    model: BaseAlgorithm,
    path: str | Path,
    config: TrainingConfig,
    optimizers: bool = True,
    extra: Callable[[zipfile.ZipFile], None] = lambda archive: None,
) -> Path:
    """Save a model as SB3 does, with the JSON member, whole or not at all.

    The action noise is saved for one slot: SB3 loads the file with an env of any number of slots.

    :param path: the zip to write
    :param config: the config that the model was built from; what :func:`~sb3_flock.serialization.load.load_policy` reads
    :param optimizers: keep the optimizers' states, which further training needs and inference does not; without them the file
        is less than half as large
    :param extra: writes further members
    :return: the path
    :raises SettingsError: if the model's observations, actions or networks are not the config's, with the field that differs; for
        a model with observations normalized by ``VecNormalize``, whose statistics the file would not hold; for a system's
        clock before 1980
    :raises OSError: if it cannot be written; an earlier file of that name stays
    """
    path = Path(path)
    check_clock()
    vec_normalize = model.get_vec_normalize_env()
    if vec_normalize is not None and vec_normalize.norm_obs:
        raise SettingsError(
            "save_model: VecNormalize normalizes the model's observations, and the file would not hold its statistics; "
            "norm_obs=False is needed, or SB3's own model.save and VecNormalize.save"
        )
    _check_config(model, config)
    member = {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "num_timesteps": model.num_timesteps,
        "versions": versions(),
    }
    with atomic_write(path) as aside:
        with open(aside, "wb") as file, _noise_of_one_slot(model), nullcontext() if optimizers else _fresh_optimizers(model):
            model.save(file, exclude=EPISODE_STATE)
        with zipfile.ZipFile(aside, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr(MEMBER, json.dumps(member, indent=1))
            extra(archive)
    return path


def _check_config(model: BaseAlgorithm, config: TrainingConfig) -> None:
    """Check that a policy built from the config has the model's observations, actions and networks.

    :raises SettingsError: naming the field that differs
    """
    with th.random.fork_rng(devices=[]):  # the networks' initialization is not part of the training
        policy = build_policy(config)
    different = _different_field(model, config, policy)
    if different is not None:
        raise SettingsError(f"save_model: the config has {different}")


def _different_field(model: BaseAlgorithm, config: TrainingConfig, policy: BasePolicy) -> str | None:
    """The first field of the config that the model was not built from, both values, or ``None``."""
    scenario, ours = config.scenario, policy.observation_space.shape
    theirs = model.observation_space.shape
    if theirs != ours:
        same_map = theirs is not None and theirs[1:] == ours[1:]  # type: ignore[index]
        name = "n_anchors" if not same_map else "motion_lag" if theirs[0] in (2 * ours[0], ours[0] / 2) else "extra_channels"  # type: ignore[index]
        return f"scenario.{name} = {getattr(scenario, name)}, observations of shape {ours}: the model's have {theirs}"
    actions: Any = model.action_space
    for index, name in enumerate(("max_speed", "max_turn_rate")):
        if actions.shape != (2,) or not np.isclose(actions.high[index], getattr(scenario, name)):
            return f"scenario.{name} = {getattr(scenario, name)}: the model's actions are {actions}"
    if not isinstance(model.policy, type(policy)):
        kind = type(model.policy).__name__
        return f"algo = {config.algo}, whose policy is a {type(policy).__name__}: the model's is a {kind}"
    if _layers(policy) == _layers(model.policy):
        return None
    own: dict[str, Any] = {**model.policy_kwargs, **(model.policy_kwargs.get("features_extractor_kwargs") or {})}
    needed = policy_kwargs(config)
    for name, value in {**needed, **needed.get("features_extractor_kwargs", {})}.items():
        found = list(own[name]) if isinstance(own.get(name), tuple) else own.get(name, value)
        if name in NetworkConfig.model_fields and name != "final_init" and found != value:
            return f"network.{name} = {value}: the model has {found}"
    layer, theirs_too = next(pair for pair in zip_longest(_layers(policy), _layers(model.policy)) if pair[0] != pair[1])
    return f"a network with {layer}: the model has {theirs_too}"


def _layers(policy: BasePolicy) -> list[str]:
    """A policy's layers and the shapes of its parameters, as lines."""
    shapes = [f"{name} {tuple(tensor.shape)}" for name, tensor in policy.state_dict().items()]
    return [*map(str.strip, str(policy).splitlines()[1:]), *shapes]  # the first line is the class


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary file that replaces ``path`` once it is complete and on the disk; on an error it is removed."""
    aside = path.with_name(f".{path.name}.tmp")
    try:
        yield aside
        with open(aside, "rb") as file:
            os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # sync the new name to the disk
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextmanager
def _noise_of_one_slot(model: BaseAlgorithm) -> Iterator[None]:
    """Temporarily the action noise that each slot has, which SB3 multiplies again where a model learns."""
    noise = getattr(model, "action_noise", None)
    if isinstance(noise, VectorizedActionNoise):
        model.action_noise = noise.base_noise
    try:
        yield
    finally:
        if noise is not None:
            model.action_noise = noise


@contextmanager
def _fresh_optimizers(model: BaseAlgorithm) -> Iterator[None]:
    """Temporarily empty optimizer states."""
    found = optimizers_of(model)
    states = [optimizer.state for optimizer in found]
    for optimizer in found:
        optimizer.state = defaultdict(dict)
    try:
        yield
    finally:
        for optimizer, state in zip(found, states, strict=True):
            optimizer.state = state
