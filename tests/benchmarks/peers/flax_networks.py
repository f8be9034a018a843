"""The networks of ``FlockPolicy`` in flax, for the DDPG of SBX: the same layers and the same action bound."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from sbx.common.type_aliases import RLTrainState
from sbx.td3.policies import TD3Policy

from sb3_flock.rl.policies import InvertingBound


@jax.custom_vjp
def inverting_bound(raw: jax.Array) -> jax.Array:
    """The twin of :class:`sb3_flock.rl.policies.InvertingBound`."""
    return jnp.clip(raw, -1.0, 1.0)


def _bound_forward(raw: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jnp.clip(raw, -1.0, 1.0), raw


def _bound_backward(raw: jax.Array, gradient: jax.Array) -> tuple[jax.Array]:
    room = jnp.where(gradient < 0, 1.0 - raw, 1.0 + raw)
    return (gradient * jnp.clip(room / InvertingBound.MARGIN, -1.0, 1.0),)


inverting_bound.defvjp(_bound_forward, _bound_backward)


class PatchesConv(nn.Module):
    """``flax.linen.Conv`` with a square kernel and no padding, as one matrix product of patches: XLA has slow convolutions."""

    channels: int
    kernel_size: int
    stride: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        size, step = self.kernel_size, self.stride
        stop = (x.shape[1] - size) // step * step + 1
        patches = [x[:, i : i + stop : step, j : j + stop : step] for i in range(size) for j in range(size)]
        shape = (size, size, x.shape[-1], self.channels)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.channels,))
        return jnp.concatenate(patches, -1) @ kernel.reshape(-1, self.channels) + bias


class Features(nn.Module):
    """The twin of :class:`sb3_flock.FlockCNN`, channels last behind its first operation."""

    network: Any
    by_patches: bool

    @nn.compact
    def __call__(self, observations: jax.Array) -> jax.Array:
        net, x = self.network, observations.transpose(0, 2, 3, 1)
        for index, channels in enumerate(net.channels):
            size, stride, name = net.kernel_size, net.stride, f"Conv_{index}"
            if self.by_patches:
                x = PatchesConv(channels, size, stride, name=name)(x)
            else:
                x = nn.Conv(channels, (size, size), (stride, stride), "VALID", name=name)(x)
            x = nn.relu(x)
        x = nn.Dense(net.features_dim)(x.reshape(len(x), -1))
        return nn.relu(nn.LayerNorm(epsilon=1e-5)(x) if net.layer_norm else x)


class Head(nn.Module):
    """Dense layers behind the features."""

    widths: Sequence[int]
    n_outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.widths:
            x = nn.relu(nn.Dense(width)(x))
        return nn.Dense(self.n_outputs)(x)


class Actor(nn.Module):
    """The actor, with the inverting bound."""

    network: Any
    by_patches: bool
    n_actions: int

    @nn.compact
    def __call__(self, observations: jax.Array) -> jax.Array:
        features = Features(self.network, self.by_patches)(observations)
        return inverting_bound(Head(self.network.net_arch, self.n_actions)(features))


class Critics(nn.Module):
    """The twin of :class:`sb3_flock.rl.policies.ActionLayerCritic`; returns ``(critics, batch, 1)``."""

    network: Any
    by_patches: bool

    @nn.compact
    def __call__(self, observations: jax.Array, actions: jax.Array) -> jax.Array:
        net, features = self.network, Features(self.network, self.by_patches)(observations)
        values = []
        for _ in range(net.n_critics):
            joined = jnp.concatenate([features, nn.relu(nn.Dense(net.action_layer)(actions))], -1)
            values.append(Head(net.net_arch, 1)(joined))
        return jnp.stack(values)


class FlaxFlockPolicy(TD3Policy):
    """SBX's policy of TD3 and DDPG with these networks.

    :param network: sb3_flock's ``NetworkConfig``
    :param by_patches: convolve by :class:`PatchesConv` in place of ``flax.linen.Conv``
    """

    def __init__(self, *args: Any, network: Any, by_patches: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "n_critics": network.n_critics})
        self.network, self.by_patches = network, by_patches

    def build(self, key: jax.Array, lr_schedule: Any, qf_learning_rate: float) -> jax.Array:
        """Make the modules and their train states; SBX calls this once."""
        key, self.key, actor_key, critic_key = jax.random.split(key, 4)
        observation, action = (jnp.asarray(space.sample())[None] for space in (self.observation_space, self.action_space))
        self.actor = Actor(self.network, self.by_patches, action.shape[1])
        self.qf = Critics(self.network, self.by_patches)
        self.actor_state = self._train_state(self.actor, lr_schedule(1), actor_key, observation)
        self.qf_state = self._train_state(self.qf, qf_learning_rate, critic_key, observation, action)
        return key

    def _train_state(self, module: nn.Module, learning_rate: float, key: jax.Array, *inputs: jax.Array) -> RLTrainState:
        parameters = module.init(key, *inputs)
        optimizer = self.optimizer_class(learning_rate=learning_rate, **self.optimizer_kwargs)
        return RLTrainState.create(apply_fn=module.apply, params=parameters, target_params=parameters, tx=optimizer)

    def take_weights(self, model: Any) -> None:
        """Take the actor's and the critics' weights of a model of sb3_flock."""
        actor, critic = model.actor, model.critic
        weights = {"Features_0": _layers(actor.features_extractor), "Head_0": _layers(actor.mu)}
        self.actor_state = self.actor_state.replace(params={"params": weights})
        weights = {"Features_0": _layers(critic.features_extractor), **_layers(critic.action_layers)}
        weights |= {f"Head_{index}": _layers(head) for index, head in enumerate(critic.q_networks)}
        self.qf_state = self.qf_state.replace(params={"params": weights})


def _layers(module: th.nn.Module) -> dict[str, dict[str, jax.Array]]:
    """The layers of a torch module by the names that flax gives them."""
    names, result = Counter[str](), {}
    for layer in module.modules():
        if isinstance(layer, th.nn.Conv2d):
            name, kernel = "Conv", {"kernel": layer.weight.permute(2, 3, 1, 0)}
        elif isinstance(layer, th.nn.Linear):
            name, kernel = "Dense", {"kernel": layer.weight.T}
        elif isinstance(layer, th.nn.LayerNorm):
            name, kernel = "LayerNorm", {"scale": layer.weight}
        else:
            continue
        leaves = {**kernel, "bias": layer.bias}
        result[f"{name}_{names[name]}"] = {key: jnp.array(leaf.detach().numpy()) for key, leaf in leaves.items()}
        names[name] += 1
    return result


def assert_twins(ours: Any, sbx: Any, batch: Any) -> None:
    """Check that the networks of both models give the same actions and values.

    :raises AssertionError: if they differ by more than 1e-4
    """
    with th.no_grad():
        actions, values = ours.actor(batch.observations), ours.critic(batch.observations, batch.actions)
    observations = batch.observations.numpy()
    policy = sbx.policy
    twin_actions = policy.actor.apply(policy.actor_state.params, observations)
    twin_values = policy.qf.apply(policy.qf_state.params, observations, batch.actions.numpy())
    np.testing.assert_allclose(actions.numpy(), twin_actions, rtol=0, atol=1e-4)
    np.testing.assert_allclose(th.stack(values).numpy(), twin_values, rtol=0, atol=1e-4)
    assert min(actions.std(), th.stack(values).std()) > 0.01, "the comparison says nothing about constant outputs"
