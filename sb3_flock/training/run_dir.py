"""A run folder: created whole, described, used by one process at a time."""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from filelock import FileLock, Timeout

from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.save import atomic_write, versions
from sb3_flock.serialization.yaml_io import to_yaml
from sb3_flock.settings import SettingsError


def check_encoding(folder: str | Path) -> None:
    """Check that a folder's name is UTF-8, which TensorBoard needs.

    :raises SettingsError: if it is not
    """
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise SettingsError(f"{folder}: TensorBoard needs a name in UTF-8") from None


def create_run_dir(config: TrainingConfig, command: Sequence[str] | None) -> Path:
    """Create the next free ``<algo>_<n>v<m>o_<k>`` with its description; two trainings at once never share one."""
    check_encoding(config.output_dir)
    root = Path(config.output_dir)
    stem = f"{config.algo}_{config.scenario.n_vehicles}v{config.scenario.n_obstacles}o"
    try:
        root.mkdir(parents=True, exist_ok=True)
        temporary = root / f".{stem}_{os.getpid()}"
        temporary.mkdir()
        describe_run(temporary, config, command)
        taken = [int(path.name[len(stem) + 1 :]) for path in root.glob(f"{stem}_*") if path.name[len(stem) + 1 :].isdigit()]
        for number in itertools.count(max(taken, default=0) + 1):
            folder = root / f"{stem}_{number}"
            try:
                temporary.rename(folder)
            except OSError:
                if not folder.exists():
                    raise
            else:
                return folder
    except OSError as error:
        raise SettingsError(f"output_dir = {config.output_dir}: {error.strerror or error}") from None
    raise AssertionError("unreachable")


@contextlib.contextmanager
def lock_run_dir(folder: Path) -> Iterator[None]:
    """Lock the run folder for this process; the lock of a killed process ends with the process."""
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise SettingsError(f"{folder}: another process trains in this folder") from None
    except OSError as error:
        raise SettingsError(f"{folder}: {error.strerror or error}") from None
    try:
        yield
    finally:
        lock.release()


def describe_run(folder: Path, config: TrainingConfig, command: Sequence[str] | None) -> None:
    """Write the config, the command (one more line if resumed) and the versions."""
    with atomic_write(folder / "config.yaml") as temporary:
        temporary.write_text(to_yaml(config), encoding="utf-8")
    with open(folder / "command.txt", "ab") as file:
        quoted = shlex.join if os.name == "posix" else subprocess.list2cmdline
        file.write(os.fsencode(quoted(command or sys.argv) + "\n"))  # a path need not be UTF-8
    (folder / "versions.txt").write_text(
        "".join(f"{name}=={number}\n" for name, number in versions().items()), encoding="utf-8"
    )
