"""The compiled update of a model: its networks as flat memory, its minibatches as indices.

The weights stay the torch modules' own memory: every parameter becomes a view of one flat tensor per network, and so do the
optimizers' moments. Saving and loading need no change.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_flock.rl.buffers import CompactReplayBuffer
from sb3_flock.rl.policies import ActionLayerCritic, FlockPolicy, InvertingBound
from sb3_flock.rl.torch_layers import FlockCNN

if TYPE_CHECKING:
    from stable_baselines3 import TD3

    from sb3_flock.rl.update_kernels import Batches, Network, ReplayArrays, Shapes, Workspace


class CompiledUpdate:
    """Updates models of DDPG or TD3 by :func:`sb3_flock.rl.update_kernels.update`, whose memory it keeps between rounds.

    One or two threads compute the halves of each minibatch and end at the same bits.
    """

    def __init__(self) -> None:
        self._flat: dict[str, th.Tensor] = {}
        self._moments: dict[str, list[th.Tensor]] = {}
        self._gradients: dict[str, NDArray[np.float32]] = {}
        self._memory: tuple[Shapes, Workspace] | None = None

    def __reduce__(self) -> tuple[type[CompiledUpdate], tuple[()]]:
        """A copy of a model has memory of its own."""
        return CompiledUpdate, ()

    def __call__(
        self, model: TD3, n_updates: int, batch_size: int, updates_before: int = 0, bc_coef: float = 0.0, threads: int = 1
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Update a model's networks ``n_updates`` times.

        :param model: the model; :func:`can_compile` says whether its update can be compiled
        :param batch_size: transitions in a minibatch
        :param updates_before: updates so far, which decide when TD3 updates the actor
        :param bc_coef: weight of the behavior cloning term in the actor's loss
        :param threads: 1 or 2
        :return: the critics' losses; the actor's, for each of its updates; its behavior cloning losses, if there is such a term
        """
        from sb3_flock.rl.update_kernels import Hyperparameters

        if self._memory is None or self._memory[0].batch != batch_size:
            shapes = _shapes(model, batch_size)
            self._memory = shapes, _workspace(shapes, get_action_dim(model.action_space))
        shapes, workspace = self._memory
        updates_actor = (updates_before + 1 + np.arange(n_updates)) % model.policy_delay == 0
        losses = np.zeros((n_updates, 3))
        _run(
            threads,
            shapes,
            self._network(model, "actor"),
            self._network(model, "critic"),
            _replay_arrays(model),
            _batches(model, n_updates, batch_size),
            Hyperparameters(
                float(model.gamma),
                float(model.tau),
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

    def _network(self, model: TD3, name: str) -> Network:
        from sb3_flock.rl.update_kernels import HALVES, Network

        online = self._flatten(name, getattr(model, name))
        target = self._flatten(f"{name}_target", getattr(model, f"{name}_target"))
        exp_avg, exp_avg_sq = self._flatten_moments(name, getattr(model, name))
        if name not in self._gradients:
            self._gradients[name] = th.zeros(HALVES, len(online)).numpy()
        return Network(online, exp_avg, exp_avg_sq, target, self._gradients[name])

    def _flatten(self, name: str, network: nn.Module) -> NDArray[np.float32]:
        """A network's parameters as one array, of which the parameters are views; moved there again if torch moved them."""
        parameters = list(network.parameters())
        flat = self._flat.get(name)
        if flat is None or not _are_views(parameters, flat):
            flat = self._flat[name] = th.cat([parameter.detach().reshape(-1) for parameter in parameters])
            for parameter, part in zip(parameters, _split(flat, parameters), strict=True):
                parameter.data = part
        return flat.numpy()

    def _flatten_moments(self, name: str, network: nn.Module) -> tuple[NDArray[np.float32], ...]:
        """The two moments of a network's Adam as arrays, of which the optimizer's state are views."""
        optimizer = network.optimizer
        assert isinstance(optimizer, th.optim.Adam)
        parameters, states = list(network.parameters()), optimizer.state
        for parameter in parameters:
            if not states[parameter]:
                states[parameter] = {
                    "step": th.zeros(()),
                    **{moment: th.zeros_like(parameter) for moment in _MOMENTS},
                }
        kept = self._moments.get(name, [])
        tensors = [[states[parameter][moment] for parameter in parameters] for moment in _MOMENTS]
        if not kept or not all(map(_are_views, tensors, kept)):
            kept = self._moments[name] = [th.cat([tensor.reshape(-1) for tensor in parts]) for parts in tensors]
            for moment, flat in zip(_MOMENTS, kept, strict=True):
                for parameter, part in zip(parameters, _split(flat, parameters), strict=True):
                    states[parameter][moment] = part
        return tuple(flat.numpy() for flat in kept)


def can_compile(model: TD3) -> bool:
    """Whether a model's update can be compiled: its parts are exactly ours, on the CPU, and the ``fast`` extra is installed.

    With ``VecNormalize`` torch updates: the compiled update reads the observations as the buffer holds them.
    """
    policy, networks = model.policy, (model.actor, model.critic)
    return (
        type(policy) is FlockPolicy
        and type(model.critic) is ActionLayerCritic
        and type(model.replay_buffer) is CompactReplayBuffer
        and all(type(network.features_extractor) is FlockCNN for network in networks)
        and not policy.share_features_extractor
        and policy.activation_fn is nn.ReLU
        and model.device.type == "cpu"
        and model.get_vec_normalize_env() is None
        and all(parameter.requires_grad for network in networks for parameter in network.parameters())
        and all(_is_plain_adam(network) for network in networks)
        and compiled_kernels() is not None
    )


def _is_plain_adam(network: nn.Module) -> bool:
    """Whether torch's Adam with default coefficients optimizes all parameters of a network, and nothing else."""
    default: dict[str, Any] = {"betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0, "amsgrad": False, "maximize": False}
    optimizer = network.optimizer
    if not isinstance(optimizer, th.optim.Adam) or isinstance(optimizer, th.optim.AdamW) or len(optimizer.param_groups) != 1:
        return False
    (group,) = optimizer.param_groups
    own = [id(parameter) for parameter in network.parameters()]
    return all(group[key] == value for key, value in default.items()) and [id(p) for p in group["params"]] == own


@functools.cache
def compiled_kernels() -> ModuleType | None:
    """:mod:`sb3_flock.rl.update_kernels`, or ``None`` where the ``fast`` extra is not installed."""
    try:
        return importlib.import_module("sb3_flock.rl.update_kernels")
    except (ImportError, RuntimeError):  # RuntimeError: there is no folder where numba may keep its cache
        return None


_MOMENTS = ("exp_avg", "exp_avg_sq")
_LOCK = threading.Lock()
"""One round at a time: the number of torch's threads is the process's."""


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Let torch's BLAS use one thread in each thread that calls it."""
    before = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(before)


def _run(threads: int, *arguments: Any) -> None:
    """Run :func:`~sb3_flock.rl.update_kernels.update` in one thread or two."""
    from sb3_flock.rl.barrier_kernels import ABORTED, new_barrier
    from sb3_flock.rl.update_kernels import update

    barrier = new_barrier()

    def run(thread: int) -> None:
        th.set_num_threads(1)
        try:
            update(thread, threads, barrier, *arguments)
        except BaseException:
            barrier[:] = ABORTED  # the other thread would wait for ever
            raise

    with _LOCK, _one_torch_thread():
        if threads == 1:
            run(0)
            return
        with ThreadPoolExecutor(1) as pool:
            try:
                second = pool.submit(run, 1)
                run(0)
            except BaseException:
                barrier[:] = ABORTED
                raise
            second.result()


def _replay_arrays(model: TD3) -> ReplayArrays:
    from sb3_flock.rl.update_kernels import ReplayArrays

    buffer = model.replay_buffer
    assert isinstance(buffer, CompactReplayBuffer)
    return ReplayArrays(
        buffer.observations.view(np.uint16).reshape(buffer.buffer_size, buffer.n_envs, -1),
        buffer.actions,
        buffer.rewards,
        buffer.dones,
        buffer.timeouts,
        np.empty((0, 0, 0), np.float32) if buffer.expert_actions is None else buffer.expert_actions,
    )


def _batches(model: TD3, n_updates: int, batch_size: int) -> Batches:
    """Draw the minibatches of a round, in the order in which SB3 draws them."""
    from sb3_flock.rl.update_kernels import Batches

    buffer = model.replay_buffer
    assert isinstance(buffer, CompactReplayBuffer)
    draws = [buffer.sample_indices(batch_size) for _ in range(n_updates)]
    rows, envs = (np.stack(parts) for parts in zip(*draws, strict=True))
    last_index, last = buffer.last_observations(rows, envs)
    n_mirrored = batch_size // 2 if buffer.mirror_augmentation else 0
    return Batches(rows, envs, last_index, last.view(np.uint16), _target_noise(model, n_updates, batch_size), n_mirrored)


def _target_noise(model: TD3, n_updates: int, batch_size: int) -> NDArray[np.float32]:
    """TD3's clipped noise on the target actions, drawn by torch as SB3 does; none for DDPG, whose clip is 0."""
    if model.target_noise_clip == 0:
        return np.empty((0, 0, 0), np.float32)
    shape = (batch_size, get_action_dim(model.action_space))
    noise = [th.empty(shape).normal_(0, model.target_policy_noise) for _ in range(n_updates)]
    return th.stack(noise).clamp_(-model.target_noise_clip, model.target_noise_clip).numpy()


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
        return th.zeros(HALVES, numbers).numpy()

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


def _are_views(tensors: Sequence[th.Tensor], flat: th.Tensor) -> bool:
    at = flat.data_ptr()
    for tensor in tensors:
        if tensor.data_ptr() != at:
            return False
        at += tensor.numel() * tensor.element_size()
    return True
