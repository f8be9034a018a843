"""What keeps a training from being lost: checkpoints on time and on signals, and a stop where the losses diverge."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flock.rl.checkpoints import LoadedCheckpoint, RandomStreams, Stateful, save_checkpoint
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.loading import checkpoint_paths
from sb3_flock.settings import RunError


class Checkpoints(BaseCallback):
    """Saves ``rl_model_<steps>_steps.zip`` every ``save_freq`` transitions and when a signal asks to stop; keeps the newest few.

    :param config: the run's config
    :param folder: the run folder
    :param parts: what has a state besides the model
    :param resumed: the checkpoint that the training goes on from
    :param signals: where to ask for signals
    """

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path,
        parts: Mapping[str, Stateful],
        resumed: LoadedCheckpoint | None,
        signals: Signals,
    ) -> None:
        super().__init__()
        self.config, self.folder, self.resumed, self.signals = config, folder, resumed, signals
        self.parts = dict(parts)
        self._last = resumed.num_timesteps if resumed else 0

    def _on_training_start(self) -> None:
        self.parts["random"] = RandomStreams(self.model)
        if self.resumed is not None:
            self.resumed.restore_parts(self.parts)
            self.resumed = None  # its replay buffer is large

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        """Between two rounds of flying and learning nothing is half done."""
        steps, freq = self.num_timesteps, self.config.save_freq
        if self.signals.caught is not None:
            self._save()
            self.signals.act()
        elif freq and steps // freq > self._last // freq:
            self._save()

    def _on_training_end(self) -> None:
        """A longer training may go on from the end."""
        self._save()

    def _save(self) -> None:
        if self.num_timesteps == self._last:
            return
        assert isinstance(self.model, OffPolicyAlgorithm)
        save_checkpoint(self.model, self.folder / f"rl_model_{self.num_timesteps}_steps.zip", self.config, self.parts)
        self._last = self.num_timesteps
        for path in checkpoint_paths(self.folder)[: -self.config.keep_checkpoints]:
            path.unlink()


class DivergedError(RunError):
    """A loss is no longer finite: to go on from the last checkpoint would end there again."""


class FiniteLosses(BaseCallback):
    """Stops a training whose losses are no longer finite, before anything of it is saved.

    :raises DivergedError: one line that names the loss
    """

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        for name, value in self.logger.name_to_value.items():
            if name.startswith("train/") and name.endswith("loss") and not np.isfinite(value):
                raise DivergedError(
                    f"{name} = {value} after {self.num_timesteps} transitions: the training diverged; a smaller "
                    "learning_rate or reward scale may help"
                )


class Signals:
    """SIGINT and SIGTERM wait until the training has saved; a second one does not wait.

    Outside the main thread, which alone gets signals, it does nothing.
    """

    def __init__(self) -> None:
        self.caught: int | None = None

    @contextlib.contextmanager
    def waiting(self) -> Iterator[Signals]:
        """Keep signals while it lasts; one that nobody has acted upon by its end acts then."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        taken = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}  # as under nohup
        for number in taken:
            signal.signal(number, self._keep)
        try:
            yield self
        finally:
            for number, handler in taken.items():
                signal.signal(number, handler)
        if self.caught is not None:
            self.act()

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self.caught is not None:
            self.act()
        self.caught = number

    def act(self) -> None:
        """Do what the caught signal asks.

        :raises KeyboardInterrupt: for SIGINT
        :raises SystemExit: for SIGTERM, with the code 143
        """
        if self.caught == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + signal.SIGTERM)
