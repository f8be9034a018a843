"""What a training shows while it runs: a live panel in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock._compat import n_updates


class FlockProgressCallback(BaseCallback):
    """Live progress: time left, env steps/s, updates/s, return, tracking error, violation rates, the last evaluation.

    The flock's figures are means over the last 10 000 transitions of the training env, exploration noise included. Without a
    terminal (a pipe, a log file) a plain line is printed after every evaluation instead.

    :param console: where to print
    :param total_timesteps: transitions of the whole training
    """

    def __init__(self, console: Console, total_timesteps: int) -> None:
        super().__init__()
        self.console = console
        self.total_timesteps = total_timesteps
        self.evaluation = ""
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            expand=True,
        )
        self._task = self._bar.add_task("training", total=total_timesteps)
        self._live: Live | None = None
        self._marks: deque[tuple[float, int, int]] = deque(maxlen=50)
        self._recent: deque[tuple[float, float, float]] = deque()
        self._last = 0.0

    def _on_training_start(self) -> None:
        self._recent = deque(maxlen=max(1, 10_000 // self.training_env.num_envs))
        if self.console.is_terminal:
            self._live = Live(self._panel(), console=self.console, refresh_per_second=4, transient=True)
            self._live.start()

    def _on_step(self) -> bool:
        metrics = [info["metrics"] for info in self.locals["infos"] if "metrics" in info]
        if metrics:
            self._recent.append(
                (
                    float(np.mean([m["tracking_error"] for m in metrics])),
                    float(np.mean([m["neighbor_violation"] for m in metrics])),
                    float(np.mean([m["obstacle_violation"] for m in metrics])),
                )
            )
        now = time.monotonic()
        if now - self._last > 0.5:
            self._last = now
            self._marks.append((now, self.num_timesteps, n_updates(self.model)))
            self._bar.update(self._task, completed=min(self.num_timesteps, self.total_timesteps))
            if self._live is not None:
                self._live.update(self._panel())
        return True

    def report_evaluation(self, line: str) -> None:
        """Show the result of an evaluation; a plain line where there is no terminal."""
        self.evaluation = line
        if self._live is not None:
            self._live.update(self._panel())
            return
        steps, updates = self.speeds()
        self.console.print(f"{line} | {steps:.0f} env steps/s, {updates:.0f} updates/s", soft_wrap=True, highlight=False)

    def speeds(self) -> tuple[float, float]:
        """Transitions and updates per second over the last half minute or so."""
        if len(self._marks) < 2:
            return 0.0, 0.0
        (t0, steps0, updates0), (t1, steps1, updates1) = self._marks[0], self._marks[-1]
        return (steps1 - steps0) / (t1 - t0), (updates1 - updates0) / (t1 - t0)

    def _on_training_end(self) -> None:
        self.stop()

    def stop(self) -> None:
        """Remove the panel; safe to call twice."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _panel(self) -> Group:
        steps, updates = self.speeds()
        episodes = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        tracking, neighbors, obstacles = np.mean(self._recent, axis=0) if self._recent else (np.nan,) * 3
        grid = Table.grid(padding=(0, 2))
        grid.add_row(
            f"{steps:,.0f} env steps/s",
            f"{updates:,.0f} updates/s",
            f"return {np.mean(episodes):.1f}" if episodes else "return -",
        )
        grid.add_row(
            f"tracking error {tracking:.3f} m",
            f"neighbor violations {100 * neighbors:.1f} %",
            f"obstacle violations {100 * obstacles:.1f} %",
        )
        return Group(self._bar, grid, Text(self.evaluation))
