"""A run's TensorBoard events and ``progress.csv``; a resumed run continues them."""

from __future__ import annotations

import contextlib
import csv
import threading
from collections.abc import Iterator
from pathlib import Path

from stable_baselines3.common.logger import CSVOutputFormat, Logger, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from sb3_flock.errors import RunError
from sb3_flock.serialization.save import atomic_write

_STEPS = "time/total_timesteps"


def make_logger(folder: Path, num_timesteps: int) -> Logger:
    """SB3's logger for a run folder; what was logged after ``num_timesteps`` transitions is dropped."""
    tensorboard = TensorBoardOutputFormat(str(folder))
    if num_timesteps:
        assert tensorboard.writer is not None
        tensorboard.writer.close()
        tensorboard.writer = SummaryWriter(log_dir=str(folder), purge_step=num_timesteps + 1)
    return Logger(str(folder), [tensorboard, _ContinuedCSV(folder / "progress.csv", num_timesteps)])


@contextlib.contextmanager
def quiet_writer_thread() -> Iterator[None]:
    """Print no disk error of TensorBoard's writer thread: the writer raises it again at the next event."""
    hook = threading.excepthook

    def without_disk_errors(args: threading.ExceptHookArgs) -> None:
        if not issubclass(args.exc_type, OSError):
            hook(args)

    threading.excepthook = without_disk_errors
    try:
        yield
    finally:
        threading.excepthook = hook


def _rows_until(path: Path, num_timesteps: int) -> list[list[str]]:
    """The header and the rows of up to so many transitions; nothing without a column of transitions."""
    with open(path, newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    if _STEPS not in header:
        return []
    column = header.index(_STEPS)
    rows = [row for row in rows if len(row) == len(header)]  # a killed run may leave half a row
    return [header, *(row for row in rows if row[column] and int(row[column]) <= num_timesteps)]


class _ContinuedCSV(CSVOutputFormat):
    """SB3's ``progress.csv`` that keeps the earlier rows of up to ``num_timesteps`` transitions.

    :raises RunError: if there is another file in its place
    """

    def __init__(self, path: Path, num_timesteps: int) -> None:
        kept: list[list[str]] = []
        if num_timesteps and path.exists():
            try:
                kept = _rows_until(path, num_timesteps)
            except (ValueError, csv.Error) as error:
                raise RunError(f"{path}: not the log of a training ({error}); move it away to go on without it") from None
        with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(kept)
        self.file = open(path, "r+", encoding="utf-8")  # noqa: SIM115 - closed by close()
        self.file.seek(0, 2)
        self.keys: list[str] = kept[0] if kept else []
        self.separator, self.quotechar = ",", '"'
