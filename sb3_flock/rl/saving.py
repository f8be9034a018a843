"""Saved policies: SB3's zip plus one JSON member, ``flock.json``, that tells the task, the learner and the versions.

SB3 ignores the member, so ``DDPG.load`` reads our files as any other. :mod:`sb3_flock.rl.loading` reads no pickle: it rebuilds
the networks from the member's plain values and loads the tensors alone.
"""

from __future__ import annotations

import json
import operator
import os
import platform
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import version
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_flock.rl.config import TrainingConfig

MEMBER = "flock.json"
FORMAT = 2
"""Version of the member's layout and of the networks' (2: the features are flattened anchor by anchor)."""
PACKAGES = ("sb3_flock", "stable_baselines3", "torch", "gymnasium", "pettingzoo", "supersuit", "numpy")
_EPISODE_STATE = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""What SB3 would save of the episodes under way, as large as the networks; a loaded model resets its env before it learns."""


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that decide a run."""
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
    :param optimizers: keep what the optimizers have gathered, which more training needs and flying does not; without it the
        file is less than half as large
    :param extra: writes further members
    :return: the path
    :raises OSError: if it cannot be written; what was there before stays
    """
    path = Path(path)
    member = {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "num_timesteps": model.num_timesteps,
        "versions": versions(),
    }
    with write_whole(path) as aside:
        with open(aside, "wb") as file, nullcontext() if optimizers else _fresh_optimizers(model):
            model.save(file, exclude=_EPISODE_STATE)
        with zipfile.ZipFile(aside, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr(MEMBER, json.dumps(member, indent=1))
            extra(archive)
    return path


@contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """A file beside ``path`` to write to, which takes its place when it is complete and on the disk; else it is removed."""
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
    if os.name == "posix":  # the new name is on the disk, too
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


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
