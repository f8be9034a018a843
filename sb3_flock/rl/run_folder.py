"""A run's folder: made whole, described, used by one process at a time."""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from filelock import FileLock, Timeout

from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.config_io import to_yaml
from sb3_flock.rl.saving import versions, write_whole
from sb3_flock.settings import SettingsError


def new_run_folder(config: TrainingConfig, command: Sequence[str] | None) -> Path:
    """Make the next free ``<algo>_<n>v<m>o_<k>``, described from its first moment; two trainings at once never share one."""
    root = Path(config.output_dir)
    stem = f"{config.algo}_{config.scenario.n_vehicles}v{config.scenario.n_obstacles}o"
    try:
        root.mkdir(parents=True, exist_ok=True)
        aside = root / f".{stem}_{os.getpid()}"
        aside.mkdir()
        describe_run(aside, config, command)
        taken = [int(path.name[len(stem) + 1 :]) for path in root.glob(f"{stem}_*") if path.name[len(stem) + 1 :].isdigit()]
        for number in itertools.count(max(taken, default=0) + 1):
            folder = root / f"{stem}_{number}"
            try:
                aside.rename(folder)
            except OSError:
                if not folder.exists():
                    raise
            else:
                return folder
    except OSError as error:
        raise SettingsError(f"output_dir = {config.output_dir}: {error.strerror or error}") from None
    raise AssertionError("unreachable")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """The run folder for this process alone; a lock of a killed process is gone with it."""
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise SettingsError(f"resume {folder}: another process trains in this folder") from None
    except OSError as error:
        raise SettingsError(f"resume {folder}: {error.strerror or error}") from None
    try:
        yield
    finally:
        lock.release()


def describe_run(folder: Path, config: TrainingConfig, command: Sequence[str] | None) -> None:
    """Write the config, the command (one more line if resumed) and the versions."""
    with write_whole(folder / "config.yaml") as aside:
        aside.write_text(to_yaml(config), encoding="utf-8")
    with open(folder / "command.txt", "a", encoding="utf-8") as file:
        file.write(shlex.join(command or sys.argv) + "\n")
    (folder / "versions.txt").write_text("".join(f"{name}=={number}\n" for name, number in versions().items()))
