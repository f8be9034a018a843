"""The callback that saves checkpoints on time and on signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flock.serialization.load import checkpoint_paths
from sb3_flock.training.checkpoint import LoadedCheckpoint, RandomStreams, Stateful
from sb3_flock.training.signals import GracefulShutdown


class CheckpointCallback(BaseCallback):
    """Saves ``rl_model_<steps>_steps.zip`` every so many transitions, keeps the newest few, and saves before a signal acts.

    With :func:`~sb3_flock.training.checkpoint.save_checkpoint` it saves everything that an exact resume needs: the replay
    buffer, the current episodes, the random streams and the states of the callbacks in ``parts``.

    :param folder: folder of the checkpoints
    :param save_freq: transitions between checkpoints; 0 saves at the end and before signals alone
    :param keep: number of newest checkpoints to keep
    :param save: called with the model, the path and the parts; the default is SB3's save, without the parts
    :param parts: callbacks with a state, by name
    :param resumed: the checkpoint that the training continues from
    :param signals: where delayed signals are found
    """

    def __init__(
        self,
        folder: str | Path,
        save_freq: int,
        keep: int = 2,
        save: Callable[[OffPolicyAlgorithm, Path, Mapping[str, Stateful]], Any] = lambda model, path, parts: model.save(
            path
        ),
        parts: Mapping[str, Stateful] | None = None,
        resumed: LoadedCheckpoint | None = None,
        signals: GracefulShutdown | None = None,
    ) -> None:
        super().__init__()
        self.folder, self.save_freq, self.keep, self.save = Path(folder), save_freq, keep, save
        self.parts, self.resumed, self.signals = dict(parts or {}), resumed, signals
        self._last = resumed.num_timesteps if resumed else 0

    def _on_training_start(self) -> None:
        self.parts["random"] = RandomStreams(self.model)
        if self.resumed is not None:
            self.resumed.restore_parts(self.parts)
            self.resumed = None  # its replay buffer is large

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        """Between two rounds of collecting and updating nothing is half done."""
        steps = self.num_timesteps
        if self.signals is not None and self.signals.caught is not None:
            self._save()
            self.signals.act()
        elif self.save_freq and steps // self.save_freq > self._last // self.save_freq:
            self._save()

    def _on_training_end(self) -> None:
        """A longer training may continue from the end."""
        self._save()

    def _save(self) -> None:
        if self.num_timesteps == self._last:
            return
        assert isinstance(self.model, OffPolicyAlgorithm)
        self.save(self.model, self.folder / f"rl_model_{self.num_timesteps}_steps.zip", self.parts)
        self._last = self.num_timesteps
        for path in checkpoint_paths(self.folder)[: -self.keep]:
            path.unlink()
