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
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_flock._compat import EPISODE_STATE, optimizers_of
from sb3_flock.config.training import TrainingConfig
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

    :param path: the zip to write
    :param optimizers: keep the optimizers' states, which further training needs and inference does not; without them the file
        is less than half as large
    :param extra: writes further members
    :return: the path
    :raises SettingsError: for a model with observations normalized by ``VecNormalize``, whose statistics the file would not hold
    :raises OSError: if it cannot be written; an earlier file of that name stays
    """
    path = Path(path)
    vec_normalize = model.get_vec_normalize_env()
    if vec_normalize is not None and vec_normalize.norm_obs:
        raise SettingsError(
            "save_model: VecNormalize normalizes the model's observations, and the file would not hold its statistics; "
            "norm_obs=False is needed, or SB3's own model.save and VecNormalize.save"
        )
    member = {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "num_timesteps": model.num_timesteps,
        "versions": versions(),
    }
    with atomic_write(path) as aside:
        with open(aside, "wb") as file, nullcontext() if optimizers else _fresh_optimizers(model):
            model.save(file, exclude=EPISODE_STATE)
        with zipfile.ZipFile(aside, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr(MEMBER, json.dumps(member, indent=1))
            extra(archive)
    return path


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
