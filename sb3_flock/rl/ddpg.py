"""FlockDDPG and FlockTD3: SB3's DDPG and TD3 with a compiled update; DDPG also with a behavior cloning term."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import ArrayLike
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.type_aliases import RolloutReturn
from torch.nn import functional as F  # noqa: N812 - torch's name for it
from torch.optim.swa_utils import get_ema_multi_avg_fn

from sb3_flock._renamed import FIELDS, warn_renamed
from sb3_flock.rl.compiled_update import CompiledUpdate, can_compile
from sb3_flock.rl.torch_layers import FlockCNN
from sb3_flock.settings import SettingsError


class FlockTD3(TD3):
    """TD3 whose :meth:`train` equals SB3's up to rounding, in a fraction of the time on a CPU.

    :param compiled: update by compiled code where :func:`~sb3_flock.rl.compiled_update.can_compile` says that it can;
        otherwise, and if this is false, by torch
    :param update_threads: threads of the compiled update, 1 or 2, which end at the same bits; 0: as many as torch has
        (``torch.set_num_threads``), two at most; not saved with the model

    The other parameters are those of SB3's ``TD3``.
    """

    bc_coef = 0.0
    update_threads = 0

    def __init__(self, *args: Any, compiled: bool = True, update_threads: int = 0, **kwargs: Any) -> None:
        self.compiled, self.update_threads = compiled, update_threads
        self._update: CompiledUpdate | None = None
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.n_envs:  # of a file that SB3 saved
            self.action_noise = noise.base_noise
        super()._setup_model()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_update", "update_threads"]

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Update the networks from the replay buffer (Algorithm 1 of the paper; one target network each)."""
        if not (self.compiled and gradient_steps and can_compile(self)):
            self._train_by_torch(gradient_steps, batch_size)
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        self._update = self._update or CompiledUpdate()
        threads = min(self.update_threads or th.get_num_threads(), 2)
        losses = self._update(self, gradient_steps, batch_size, self._n_updates, self.bc_coef, threads)
        self._n_updates += gradient_steps
        self._log_losses(*losses)

    def _train_by_torch(self, gradient_steps: int, batch_size: int) -> None:
        """The reference of the compiled update: SB3's own."""
        super().train(gradient_steps, batch_size)

    def _log_losses(self, critic: ArrayLike, actor: ArrayLike, bc: ArrayLike) -> None:
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, losses in (("actor", actor), ("critic", critic), ("bc", bc)):
            if np.size(losses):
                self.logger.record(f"train/{name}_loss", np.mean(np.asarray(losses)))


class FlockDDPG(FlockTD3, DDPG):
    """DDPG whose :meth:`train` equals SB3's up to rounding, in a fraction of the time on a CPU (Algorithm 1 of the paper).

    Without compiled code, torch's takes 0.5 to 0.65 of SB3's time: the patches of a minibatch are gathered once for all
    networks with that input; the actor's step computes no gradient of the critic's weights, which no optimizer would use; the
    target networks are updated in one operation; losses are read once a round.

    :param compiled: as in :class:`FlockTD3`; ``update_threads`` too
    :param bc_coef: weight of the behavior cloning term in the actor's loss: the mean absolute difference to the expert's
        actions, each scaled to [-1, 1] (as in TD3+BC, with the absolute difference); if it is not 0, the replay buffer must
        be a :class:`CompactReplayBuffer` with ``store_expert_actions``

    The other parameters are those of SB3's ``DDPG``. Every features extractor must be a :class:`FlockCNN`.
    """

    def __init__(self, *args: Any, bc_coef: float = 0.0, **kwargs: Any) -> None:
        for old, new in FIELDS["FlockDDPG"].items():  # arguments of the previous release
            if old in kwargs:
                if bc_coef:
                    raise TypeError(f"FlockDDPG got {new} and its old name {old}")
                warn_renamed(f"FlockDDPG: {old}", new)
                bc_coef = kwargs.pop(old)
        self.bc_coef = bc_coef
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        for old, new in FIELDS["FlockDDPG"].items():  # attributes of a file from the previous release
            if old in vars(self):
                setattr(self, new, vars(self).pop(old))
        super()._setup_model()
        for network in (self.actor, self.critic):
            extractor = network.features_extractor
            if not isinstance(extractor, FlockCNN):
                raise SettingsError(
                    f"features_extractor_class = {type(extractor).__name__}: FlockDDPG needs FlockCNN; SB3's DDPG takes any"
                )

        if self.bc_coef and getattr(self.replay_buffer, "expert_actions", None) is None:
            raise SettingsError(
                f"bc_coef = {self.bc_coef}: a CompactReplayBuffer with store_expert_actions=True is needed, or bc_coef 0"
            )

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As SB3's.

        :raises SettingsError: if ``bc_coef`` is not 0 and the infos have no ``expert_action``
        """
        collected = super().collect_rollouts(*args, **kwargs)
        if self.bc_coef and getattr(self.replay_buffer, "lacks_expert_actions", False):
            raise SettingsError(
                f"bc_coef = {self.bc_coef}: the infos have no expert_action; an ExpertEnv with queries=True gives it, "
                "or bc_coef 0 is needed"
            )
        return collected

    def _train_by_torch(self, gradient_steps: int, batch_size: int) -> None:
        """The reference of the compiled update."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        extractor: FlockCNN = self.critic.features_extractor  # type: ignore[assignment]
        actor, critic = list(self.actor.parameters()), list(self.critic.parameters())
        targets = list(self.actor_target.parameters()) + list(self.critic_target.parameters())
        follow = get_ema_multi_avg_fn(1.0 - self.tau)  # type: ignore[no-untyped-call]
        actor_losses, critic_losses, bc_losses = [], [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size, env=self.get_vec_normalize_env())  # type: ignore[union-attr]
            discounts = self.gamma if batch.discounts is None else batch.discounts
            observations = extractor.patches(batch.observations)
            with th.no_grad():
                next_observations = extractor.patches(batch.next_observations)
                next_actions = self.actor_target(next_observations)
                next_values = th.cat(self.critic_target(next_observations, next_actions), dim=1).amin(1, keepdim=True)
                target_values = batch.rewards + (1 - batch.dones) * discounts * next_values

            values = self.critic(observations, batch.actions)
            critic_loss = th.stack([F.mse_loss(value, target_values) for value in values]).sum()
            _step(self.critic.optimizer, critic_loss, critic)

            actions = self.actor(observations)
            actor_loss = -self.critic.q1_forward(observations, actions).mean()
            if self.bc_coef:
                bc_loss = F.l1_loss(actions, batch.expert_actions)  # type: ignore[union-attr]
                actor_loss = actor_loss + self.bc_coef * bc_loss
                bc_losses.append(bc_loss.detach())
            _step(self.actor.optimizer, actor_loss, actor)

            follow(targets, actor + critic, None)
            critic_losses.append(critic_loss.detach())
            actor_losses.append(actor_loss.detach())

        self._log_losses(
            *(th.stack(losses).tolist() if losses else () for losses in (critic_losses, actor_losses, bc_losses))
        )


def _step(optimizer: th.optim.Optimizer, loss: th.Tensor, parameters: list[th.nn.Parameter]) -> None:
    """One step of the optimizer along the gradient in these parameters alone."""
    for parameter, gradient in zip(parameters, th.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    optimizer.step()
