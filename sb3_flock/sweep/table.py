"""The progress of a sweep: a live table in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from ray import tune
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sb3_flock.console import PlainConsole
from sb3_flock.evaluation.metrics import columns
from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells


class TrialsTable(tune.Callback):
    """The running trials and those that ended last, with their latest evaluations.

    Ray pickles this callback with the sweep's state; unpickled, it is a new one.
    """

    def __init__(self) -> None:
        self.console = PlainConsole(stderr=True)
        self._live: Live | None = None
        self._drawn = 0.0
        self._ended: list[Any] = []

    def __reduce__(self) -> tuple[type[TrialsTable], tuple[()]]:
        return type(self), ()

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        """Redraw, once a second at most."""
        if self.console.is_terminal and time.monotonic() - self._drawn > 1.0:
            self._draw(trials)

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A trial starts or resumes."""
        self._report(trials, f"{trial}: starts")

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A trial was lost with its process or its machine, and will resume."""
        self._report(trials, f"{trial}: lost; resumes from its last checkpoint")

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A trial has ended."""
        self._ended.append(trial)
        named = zip(columns().values(), _cells(trial), strict=True)
        self._report(trials, f"{trial}: {', '.join([_state(trial), *(f'{name} {cell}' for name, cell in named if cell)])}")

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A trial has failed, after all retries."""
        self._ended.append(trial)
        self._report(trials, f"{trial}: failed")

    def on_experiment_end(self, trials: list[Any], **info: Any) -> None:
        """Draw the last table, which stays on the screen."""
        if self._live is not None:
            self._draw(trials)
            self._live.stop()
            self._live = None

    def _report(self, trials: list[Any], line: str) -> None:
        if self.console.is_terminal:
            self._draw(trials)
        else:
            counts = Counter(map(_state, trials))
            self.console.print(f"[{counts['done']} of {len(trials)} done] {line}", soft_wrap=True)

    def _draw(self, trials: list[Any]) -> None:
        self._drawn = time.monotonic()
        if self._live is None:
            self._live = Live(console=self.console, refresh_per_second=2)
            self._live.start()
        counts = Counter(map(_state, trials))
        summary = ", ".join(f"{count} {state}" for state, count in counts.items())
        self._live.update(Group(self._table(trials), Text(summary)))

    def _table(self, trials: list[Any]) -> Table:
        table = plain_table(gap=1)
        widths = [max(map(len, ["100.00%", *heading.split()])) for heading in columns().values()]
        others = sum(1 + width for width in (len("running"), len("done"), *widths))
        table.add_column("trial", no_wrap=True, overflow="ellipsis", max_width=max(12, self.console.width - others - 2))
        for heading in ("state", "done"):
            table.add_column(heading, justify="right", no_wrap=True)
        add_short_columns(table)
        running = [trial for trial in trials if trial.status == "RUNNING"]
        room = max(4, self.console.height - 6)
        running = running[:room]
        ended = self._ended[len(self._ended) - min(len(self._ended), room - len(running)) :]
        for trial in [*ended, *running]:
            table.add_row(str(trial), _state(trial), _share(trial), *_cells(trial))
        return table


_STATES = {"PENDING": "waiting", "RUNNING": "running", "PAUSED": "waiting", "ERROR": "failed", "TERMINATED": "stopped"}


def _state(trial: Any) -> str:
    """The status in the last report; without one, Ray's."""
    return str((trial.last_result or {}).get("status", _STATES[trial.status]))


def _share(trial: Any) -> str:
    report = trial.last_result or {}
    total = report.get("total_timesteps")
    return "" if total is None else f"{min(1.0, report['timesteps'] / total):.0%}"


def _cells(trial: Any) -> list[str]:
    """The metrics of the test; before it, of the last evaluation."""
    report = trial.last_result or {}
    return short_cells({**report, **report.get("test", {})}, missing="")
