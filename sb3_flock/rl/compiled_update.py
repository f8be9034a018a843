"""The compiled update of a model: its networks as flat memory, its minibatches as indices.

The weights stay the torch modules' own memory: every parameter becomes a view of one flat tensor per network, and so do the
optimizers' moments. Saving, loading and SB3 itself see nothing new.
"""

from __future__ import annotations

import functools
import importlib
import os
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_flock.rl.buffers import CompactReplayBuffer
from sb3_flock.rl.policies import FlockPolicy, InvertingBound
from sb3_flock.rl.torch_layers import FlockCNN

if TYPE_CHECKING:
    from stable_baselines3 import TD3

    from sb3_flock.rl.update_kernels import Batches, Learned, Replay, Shapes, Workspace


class CompiledUpdate:
    """Updates a model of DDPG or TD3 by :func:`sb3_flock.rl.update_kernels.update`.

    One or two threads compute the halves of each minibatch (:func:`update_threads`) and end at the same bits.

    :param model: the model; :func:`can_compile` says whether it can be compiled
    """

    def __init__(self, model: TD3) -> None:
        from threadpoolctl import ThreadpoolController

        kernels = compiled_kernels()
        assert kernels is not None
        self.kernels, self.model = kernels, model
        self._flat: dict[str, th.Tensor] = {}
        self._moments: dict[str, list[th.Tensor]] = {}
        self._gradients: dict[str, NDArray[np.float32]] = {}
        self._memory: dict[int, tuple[Shapes, Workspace]] = {}
        self._blas = ThreadpoolController().select(user_api="blas")

    def __getstate__(self) -> dict[str, Any]:
        """A copy of the model gets flat memory of its own at its next update."""
        return {"model": self.model}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def __call__(
        self, n_updates: int, batch_size: int, updates_before: int = 0, bc_coef: float = 0.0, threads: int = 0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Update the networks ``n_updates`` times.

        :param batch_size: transitions in a minibatch
        :param updates_before: updates so far, which decide when TD3 updates the actor
        :param bc_coef: weight of the behavior cloning term in the actor's loss
        :param threads: as in :func:`update_threads`
        :return: the critics' losses; the actor's, for each of its updates; its behavior cloning losses, if there is such a term
        """
        model = self.model
        if batch_size not in self._memory:
            shapes = _shapes(model, batch_size)
            self._memory[batch_size] = shapes, _workspace(shapes, get_action_dim(model.action_space))
        shapes, workspace = self._memory[batch_size]
        updates_actor = (updates_before + 1 + np.arange(n_updates)) % model.policy_delay == 0
        losses = np.zeros((n_updates, 3))
        self._run(
            update_threads(threads),
            shapes,
            self._learned("actor"),
            self._learned("critic"),
            self._replay(),
            self._batches(n_updates, batch_size),
            self.kernels.Rule(
                model.gamma,
                model.tau,
                float(bc_coef),
                _learning_rate(model.actor),
                _learning_rate(model.critic),
            ),
            workspace,
            (_steps(model.actor), _steps(model.critic)),
            updates_actor,
            losses,
        )
        for network, count in ((model.actor, int(updates_actor.sum())), (model.critic, n_updates)):
            for state in network.optimizer.state.values():
                state["step"] += count
        return losses[:, 0], losses[updates_actor, 1], losses[updates_actor, 2] if bc_coef else np.empty(0)

    def _run(self, threads: int, *arguments: Any) -> None:
        """Run :func:`~sb3_flock.rl.update_kernels.update` in one thread or two."""
        from sb3_flock.rl.barrier_kernels import new_barrier

        update, barrier = self.kernels.update, new_barrier()
        with self._blas.limit(limits=1):
            if threads == 1:
                update(0, 1, barrier, *arguments)
                return
            with ThreadPoolExecutor(1) as pool:
                second = pool.submit(update, 1, 2, barrier, *arguments)
                update(0, 2, barrier, *arguments)
                second.result()

    def _replay(self) -> Replay:
        buffer = self.model.replay_buffer
        assert isinstance(buffer, CompactReplayBuffer)
        return self.kernels.Replay(
            buffer.observations.view(np.uint16).reshape(buffer.buffer_size, buffer.n_envs, -1),
            buffer.actions,
            buffer.rewards,
            buffer.dones,
            buffer.timeouts,
            np.empty((0, 0, 0), np.float32) if buffer.expert_actions is None else buffer.expert_actions,
        )

    def _batches(self, n_updates: int, batch_size: int) -> Batches:
        """Draw the minibatches of a round, in the order in which SB3 draws them."""
        buffer = self.model.replay_buffer
        assert isinstance(buffer, CompactReplayBuffer)
        draws = [buffer.draw(batch_size) for _ in range(n_updates)]
        rows, envs = (np.stack(parts) for parts in zip(*draws, strict=True))
        last_index, last = buffer.last_observations(rows, envs)
        noise, n_mirrored = self._target_noise(n_updates, batch_size), batch_size // 2 if buffer.mirror_augmentation else 0
        return self.kernels.Batches(rows, envs, last_index, last.view(np.uint16), noise, n_mirrored)

    def _learned(self, name: str) -> Learned:
        online, target = self._flatten(name), self._flatten(f"{name}_target")
        mean, square = self._flatten_moments(name)
        return self.kernels.Learned(online, mean, square, target, self._gradients[name])

    def _target_noise(self, n_updates: int, batch_size: int) -> NDArray[np.float32]:
        """TD3's clipped noise on the target actions, drawn by torch as SB3 does; none for DDPG, whose clip is 0."""
        model = self.model
        if model.target_noise_clip == 0:
            return np.empty((0, 0, 0), np.float32)
        shape = (batch_size, *model.action_space.shape)  # type: ignore[misc]
        noise = [th.empty(shape).normal_(0, model.target_policy_noise) for _ in range(n_updates)]
        return th.stack(noise).clamp_(-model.target_noise_clip, model.target_noise_clip).numpy()

    def _flatten(self, name: str) -> NDArray[np.float32]:
        """A network's parameters as one array, of which the parameters are views; moved there again if torch moved them."""
        parameters = list(getattr(self.model, name).parameters())
        flat = self._flat.get(name)
        if flat is None or not _are_views(parameters, flat):
            flat = self._flat[name] = th.cat([parameter.detach().reshape(-1) for parameter in parameters])
            for parameter, part in zip(parameters, _split(flat, parameters), strict=True):
                parameter.data = part
            self._gradients[name] = np.zeros((self.kernels.HALVES, len(flat)), np.float32)
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
        keys = ("exp_avg", "exp_avg_sq")
        kept = self._moments.get(name, [])
        if not kept or not all(
            _are_views([states[p][key] for p in parameters], flat) for key, flat in zip(keys, kept, strict=True)
        ):
            kept = [th.cat([states[p][key].reshape(-1) for p in parameters]) for key in keys]
            self._moments[name] = kept
            for key, flat in zip(keys, kept, strict=True):
                for parameter, part in zip(parameters, _split(flat, parameters), strict=True):
                    states[parameter][key] = part
        mean, square = kept
        return mean.numpy(), square.numpy()


def can_compile(model: TD3) -> bool:
    """Whether a model's update can be compiled: the ``fast`` extra is installed, the model is on the CPU and has our parts."""
    if compiled_kernels() is None:
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


def update_threads(wanted: int = 0) -> int:
    """Threads of an update: one or two, as wanted; 0: two where the process may use two cores, unless OMP_NUM_THREADS is 1."""
    if os.name != "posix":  # the barrier yields the core by sched_yield
        return 1
    return min(wanted or (2 if cores() > 1 and os.environ.get("OMP_NUM_THREADS") != "1" else 1), 2)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def compiled_kernels() -> ModuleType | None:
    """:mod:`sb3_flock.rl.update_kernels`, or ``None`` where the ``fast`` extra is not installed."""
    try:
        importlib.import_module("threadpoolctl")
        importlib.import_module("scipy.linalg.cython_blas")  # loads the BLAS that numba uses
        return importlib.import_module("sb3_flock.rl.update_kernels")
    except (ImportError, RuntimeError):  # RuntimeError: there is no folder where numba may keep its cache
        return None


def _learning_rate(network: nn.Module) -> float:
    return float(network.optimizer.param_groups[0]["lr"])  # type: ignore[union-attr, index]


def _steps(network: nn.Module) -> int:
    """Steps that a network's optimizer has taken."""
    return int(next(iter(network.optimizer.state.values()))["step"])  # type: ignore[union-attr, operator]


def _shapes(model: TD3, batch_size: int) -> Shapes:
    from sb3_flock.rl.update_kernels import Shapes

    extractor, critic = model.critic.features_extractor, model.critic
    assert isinstance(extractor, FlockCNN)
    convolutions = [module for module in extractor.cnn if isinstance(module, nn.Conv2d)]
    kernel_size, stride = convolutions[0].kernel_size[0], convolutions[0].stride[0]
    channels, side, _ = extractor.input_shape
    rows, starts, below = [], [], side
    for convolution in convolutions:
        corners = np.arange(0, below - kernel_size + 1, stride)
        first = (corners[:, None, None] + np.arange(kernel_size)) * below + corners[None, :, None]
        starts.append(first.reshape(-1) * convolution.in_channels)
        rows.append(
            (convolution.out_channels, convolution.in_channels, len(corners) ** 2, convolution.in_channels * below**2)
        )
        below = len(corners)
    padded = np.zeros((len(starts), max(map(len, starts))), np.int64)
    for row, values in zip(padded, starts, strict=True):
        row[: len(values)] = values
    action_layer: int = critic.action_layers[0][0].out_features  # type: ignore[index, union-attr]
    return Shapes(
        batch_size,
        channels,
        side,
        kernel_size,
        np.array(rows),
        padded,
        extractor.features_dim,
        any(isinstance(module, nn.LayerNorm) for module in extractor.dense),
        np.array([extractor.features_dim, *_widths(model.actor.mu)]),
        np.array([extractor.features_dim + action_layer, *_widths(critic.q_networks[0])]),
        critic.n_critics,
        action_layer,
        isinstance(model.actor.mu[-1], InvertingBound),
        InvertingBound.MARGIN,
        _n_parameters(extractor),
        _n_parameters(extractor) + sum(_n_parameters(network) for network in critic.q_networks),
    )


def _workspace(shapes: Shapes, n_actions: int) -> Workspace:
    from sb3_flock.rl.update_kernels import HALVES, Workspace

    n, area = (shapes.batch + 1) // HALVES, shapes.kernel_size**2
    outputs = [channels * positions for channels, _, positions, _ in shapes.convolutions.tolist()]
    patches = [below * positions * area for _, below, positions, _ in shapes.convolutions.tolist()]
    kernels = sum(channels * (below * area + 1) for channels, below, _, _ in shapes.convolutions.tolist())
    hidden = max(sum(shapes.actor_widths), sum(shapes.critic_widths))

    def memory(numbers: int) -> NDArray[np.float32]:
        return np.zeros((HALVES, numbers), np.float32)

    return Workspace(
        images=memory(n * shapes.channels * shapes.side**2),
        patches=memory(n * patches[0]),
        next_patches=memory(n * patches[0]),
        inputs=memory(n * sum(patches[1:])),
        inputs_back=memory(n * max(patches[1:], default=0)),
        outputs=memory(n * sum(outputs)),
        outputs_back=memory(n * sum(outputs)),
        kernels=memory(kernels),
        dense=memory(n * shapes.features),
        normed=memory(n * shapes.features),
        scale=memory(n),
        features=memory(n * shapes.features),
        features_back=memory(n * shapes.features),
        hidden=memory(n * hidden),
        hidden_back=memory(n * hidden),
        critic_hidden=memory(n * hidden),
        joined=memory(n * (shapes.features + shapes.action_layer)),
        joined_back=memory(n * (shapes.features + shapes.action_layer)),
        action_layer=memory(n * shapes.action_layer),
        actions=memory(n * n_actions),
        expert=memory(n * n_actions),
        chosen=memory(n * n_actions),
        raw=memory(n * n_actions),
        raw_back=memory(n * n_actions),
        value=memory(n),
        value_back=memory(n),
        target=memory(n),
        losses=np.zeros((HALVES, 3)),
    )


def _n_parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def _widths(network: nn.Module) -> list[int]:
    return [module.out_features for module in network.modules() if isinstance(module, nn.Linear)]


def _split(flat: th.Tensor, parameters: list[Any]) -> list[th.Tensor]:
    """Views of a flat tensor in the parameters' shapes."""
    sizes = [parameter.numel() for parameter in parameters]
    return [part.view(parameter.shape) for part, parameter in zip(th.split(flat, sizes), parameters, strict=True)]


def _are_views(tensors: list[th.Tensor], flat: th.Tensor) -> bool:
    at = flat.data_ptr()
    for tensor in tensors:
        if tensor.data_ptr() != at:
            return False
        at += tensor.numel() * tensor.element_size()
    return True
