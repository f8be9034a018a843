"""The compiled update of a model: its networks as flat memory, its minibatches as indices.

The weights stay the torch modules' own memory: every parameter becomes a view of one flat tensor per network, and so do the
optimizers' moments. Saving, loading and SB3 itself see nothing new.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_flock.rl.buffers import CompactReplayBuffer
from sb3_flock.rl.policies import FlockPolicy, InvertingBound
from sb3_flock.rl.torch_layers import FlockCNN

if TYPE_CHECKING:
    from stable_baselines3 import TD3

    from sb3_flock.rl.update_kernels import Learned, Shapes


class CompiledUpdate:
    """Updates a model of DDPG or TD3 by :func:`sb3_flock.rl.update_kernels.update`.

    :param model: the model; :func:`can_compile` says whether it can be compiled
    """

    def __init__(self, model: TD3) -> None:
        self.model = model
        self._flat: dict[str, th.Tensor] = {}
        self._moments: dict[str, tuple[th.Tensor, th.Tensor]] = {}
        self._gradients: dict[str, NDArray[np.float32]] = {}
        self._shapes: dict[int, Shapes] = {}

    def __call__(
        self, n_updates: int, batch_size: int, updates_before: int = 0, bc_coef: float = 0.0
    ) -> NDArray[np.float64]:
        """Update the networks ``n_updates`` times.

        :param updates_before: updates so far, which decide when TD3 updates the actor
        :return: ``(updates, 3)``: critic loss, actor loss and behavior cloning loss; NaN where the actor was not updated
        """
        from sb3_flock.rl.update_kernels import Batches, Learned, Replay, update

        model, buffer = self.model, self.model.replay_buffer
        assert isinstance(buffer, CompactReplayBuffer)
        learned: list[Learned] = []
        for name in ("actor", "critic"):
            online, target = self._flatten(name), self._flatten(f"{name}_target")
            mean, square = self._flatten_moments(name)
            learned.append(Learned(online, self._gradients[name], mean, square, target))
        draws = [buffer.draw(batch_size) for _ in range(n_updates)]
        rows, envs = (np.stack(parts) for parts in zip(*draws, strict=True))
        last_index, last = buffer.last_observations(rows, envs)
        none = np.empty((0, 0, 0), np.float32)
        losses = np.zeros((n_updates, 3))
        steps = [self._step(name) for name in ("actor", "critic")]
        update(
            self._shapes_of(batch_size),
            *learned,
            Replay(
                buffer.observations.view(np.uint16).reshape(buffer.buffer_size, buffer.n_envs, -1),
                buffer.actions,
                buffer.rewards,
                buffer.dones * (1 - buffer.timeouts),
                none if buffer.expert_actions is None else buffer.expert_actions,
            ),
            Batches(rows, envs, last_index, last.view(np.uint16), self._target_noise(n_updates, batch_size)),
            *steps,
            model.policy_delay,
            updates_before,
            (self._learning_rate("actor"), self._learning_rate("critic")),
            model.gamma,
            model.tau,
            float(bc_coef),
            batch_size // 2 if buffer.mirror_augmentation else 0,
            losses,
        )
        for name, count in (("actor", int(np.isfinite(losses[:, 1]).sum())), ("critic", n_updates)):
            for state in getattr(model, name).optimizer.state.values():
                state["step"] += count
        return losses

    def _target_noise(self, n_updates: int, batch_size: int) -> NDArray[np.float32]:
        """TD3's clipped noise on the target actions, drawn by torch as SB3 does; none for DDPG, whose clip is 0."""
        model = self.model
        if model.target_noise_clip == 0:
            return np.empty((0, 0, 0), np.float32)
        shape = (batch_size, *model.action_space.shape)  # type: ignore[misc]
        noise = [th.empty(shape).normal_(0, model.target_policy_noise) for _ in range(n_updates)]
        return th.stack(noise).clamp_(-model.target_noise_clip, model.target_noise_clip).numpy()

    def _learning_rate(self, name: str) -> float:
        return float(getattr(self.model, name).optimizer.param_groups[0]["lr"])

    def _step(self, name: str) -> int:
        states = getattr(self.model, name).optimizer.state
        return int(next(iter(states.values()))["step"])

    def _flatten(self, name: str) -> NDArray[np.float32]:
        """A network's parameters as one array, of which the parameters are views; moved there again if torch moved them."""
        parameters = list(getattr(self.model, name).parameters())
        flat = self._flat.get(name)
        if flat is None or not _are_views(parameters, flat):
            flat = self._flat[name] = th.cat([parameter.detach().reshape(-1) for parameter in parameters])
            for parameter, part in zip(parameters, _split(flat, parameters), strict=True):
                parameter.data = part
            self._gradients[name] = np.zeros(len(flat), np.float32)
        return flat.numpy()

    def _flatten_moments(self, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The two moments of a network's Adam as arrays, of which the optimizer's state are views."""
        network = getattr(self.model, name)
        parameters, states = list(network.parameters()), network.optimizer.state
        for parameter in parameters:
            if not states[parameter]:
                states[parameter]["step"] = th.zeros(())
                for moment in ("exp_avg", "exp_avg_sq"):
                    states[parameter][moment] = th.zeros_like(parameter)
        kept = self._moments.get(name)
        keys = ("exp_avg", "exp_avg_sq")
        if kept is None or not all(
            _are_views([states[p][key] for p in parameters], flat) for key, flat in zip(keys, kept, strict=True)
        ):
            kept = tuple(th.cat([states[p][key].reshape(-1) for p in parameters]) for key in keys)  # type: ignore[assignment]
            self._moments[name] = kept
            for key, flat in zip(keys, kept, strict=True):
                for parameter, part in zip(parameters, _split(flat, parameters), strict=True):
                    states[parameter][key] = part
        mean, square = kept
        return mean.numpy(), square.numpy()

    def _shapes_of(self, batch_size: int) -> Shapes:
        if batch_size not in self._shapes:
            self._shapes[batch_size] = _shapes(self.model, batch_size)
        return self._shapes[batch_size]


def can_compile(model: TD3) -> bool:
    """Whether a model's update can be compiled: numba is installed, the model is on the CPU, and it has our parts."""
    try:
        import numba  # noqa: F401
        import scipy.linalg  # noqa: F401 - numba's matrix products
    except ImportError:
        return False
    return (
        isinstance(model.policy, FlockPolicy)
        and isinstance(model.replay_buffer, CompactReplayBuffer)
        and model.device.type == "cpu"
        and all(
            isinstance(network.features_extractor, FlockCNN) and type(network.features_extractor).forward is FlockCNN.forward
            for network in (model.actor, model.critic)
        )
        and all(_is_plain_adam(network.optimizer) for network in (model.actor, model.critic))
    )


def _is_plain_adam(optimizer: th.optim.Optimizer) -> bool:
    default: dict[str, Any] = {"betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0, "amsgrad": False, "maximize": False}
    groups = optimizer.param_groups
    return type(optimizer) is th.optim.Adam and len(groups) == 1 and all(groups[0][k] == v for k, v in default.items())


def _shapes(model: TD3, batch_size: int) -> Shapes:
    from sb3_flock.rl.update_kernels import Shapes

    extractor, critic = model.critic.features_extractor, model.critic
    assert isinstance(extractor, FlockCNN)
    channels, side, _ = extractor._observation_space.shape
    convolutions = [module for module in extractor.cnn if isinstance(module, nn.Conv2d)]
    area = convolutions[0].kernel_size[0] ** 2
    taps = [getattr(extractor, f"_taps{layer}").numpy().astype(np.int64) for layer in range(len(convolutions))]
    # The first convolution's weights are (channels, taps) in memory, its patches (taps, channels).
    first = np.ascontiguousarray(taps[0].reshape(-1, area, channels).transpose(0, 2, 1)).reshape(-1)
    positions = [len(first) // (area * channels), *(len(tap) // area for tap in taps[1:])]
    padded = np.zeros((len(convolutions), max(map(len, taps[1:]), default=1)), np.int64)
    for layer in range(1, len(convolutions)):
        padded[layer, : len(taps[layer])] = taps[layer]
    rows = [
        (conv.out_channels, conv.in_channels * area, n, conv.in_channels)
        for conv, n in zip(convolutions, positions, strict=True)
    ]
    action_layer: int = critic.action_layers[0][0].out_features  # type: ignore[index, union-attr]
    return Shapes(
        batch_size,
        np.array(rows),
        first,
        first // side * side + (side - 1 - first % side),
        padded,
        extractor.features_dim,
        any(isinstance(module, nn.LayerNorm) for module in extractor.dense),
        np.array([extractor.features_dim, *_widths(model.actor.mu)]),
        np.array([extractor.features_dim + action_layer, *_widths(critic.q_networks[0])]),
        critic.n_critics,
        action_layer,
        isinstance(model.actor.mu[-1], InvertingBound),
        InvertingBound.MARGIN,
    )


def _widths(network: nn.Module) -> list[int]:
    return [module.out_features for module in network.modules() if isinstance(module, nn.Linear)]


def _split(flat: th.Tensor, parameters: list[Any]) -> list[th.Tensor]:
    """Views of a flat tensor in the parameters' shapes."""
    sizes = [parameter.numel() for parameter in parameters]
    return [part.view(parameter.shape) for part, parameter in zip(flat.split(sizes), parameters, strict=True)]


def _are_views(tensors: list[th.Tensor], flat: th.Tensor) -> bool:
    at = flat.data_ptr()
    for tensor in tensors:
        if tensor.data_ptr() != at:
            return False
        at += tensor.numel() * tensor.element_size()
    return True
