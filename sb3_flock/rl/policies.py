"""Policies whose critic has a hidden layer for the action, as in section IV-C of the paper."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_flock.rl.torch_layers import FlockCNN


class ActionLayerCritic(ContinuousCritic):
    """Q(s, a) with one hidden layer for the action, which joins the state path before its last hidden layer.

    Joined after it, Q would be a sum f(s) + g(a) and its gradient in the action would not see the state.

    :param action_layer: width of the action's hidden layer
    :param final_init: bound of the uniform initialization of each network's output layer; ``None`` keeps torch's own

    The other parameters are those of SB3's ``ContinuousCritic``.
    """

    def __init__(self, *args: Any, action_layer: int = 32, final_init: float | None = 3e-3, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        action_dim = get_action_dim(self.action_space)
        features_dim, net_arch = kwargs["features_dim"], kwargs["net_arch"]
        activation_fn = kwargs.get("activation_fn", nn.ReLU)
        self.action_layers = nn.ModuleList()
        for index in range(self.n_critics):
            self.action_layers.append(nn.Sequential(nn.Linear(action_dim, action_layer), activation_fn()))
            q_net = nn.Sequential(*create_mlp(features_dim + action_layer, 1, net_arch, activation_fn))
            init_output_layer(q_net, final_init)
            setattr(self, f"qf{index}", q_net)
            self.q_networks[index] = q_net

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """The value of each critic network, each ``(batch, 1)``."""
        with th.set_grad_enabled(not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        return tuple(self._value(index, features, actions) for index in range(self.n_critics))

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """The first network's value alone, ``(batch, 1)``; the state path gets no gradient."""
        with th.no_grad():
            features = self.extract_features(obs, self.features_extractor)
        return self._value(0, features, actions)

    def _value(self, index: int, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.q_networks[index](th.cat([features, self.action_layers[index](actions)], dim=1))


class _InvertingClamp(th.autograd.Function):
    """Clamps to [-1, 1]; an outward gradient shrinks to 0 at the bound and changes its sign beyond it."""

    @staticmethod
    def forward(ctx: Any, raw: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(raw)
        return raw.clamp(-1.0, 1.0)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:
        (raw,) = ctx.saved_tensors
        # Descent along a negative gradient raises the output: then the upper bound counts.
        room = th.where(gradient < 0, 1.0 - raw, 1.0 + raw)
        return gradient * (room / InvertingBound.MARGIN).clamp(-1.0, 1.0)


class InvertingBound(nn.Module):
    """The actor's action bound: a clamp to [-1, 1] with inverting gradients (after Hausknecht and Stone, 2016).

    A tanh saturates in this task: standing still is a bound of the speed, the tanh's input goes to -10 and beyond, and its
    gradient vanishes. This bound is reached exactly, and left as soon as the critic's gradient points inwards.
    """

    MARGIN = 0.1
    """Distance from the bound at which an outward gradient starts to shrink."""

    def forward(self, raw: th.Tensor) -> th.Tensor:
        """Bounded actions, of the input's shape."""
        return _InvertingClamp.apply(raw)


def init_output_layer(network: nn.Module, bound: float | None) -> None:
    """Initialize the last linear layer of a network uniformly in ``[-bound, bound]``: a tanh behind it is then not saturated."""
    if bound is None:
        return
    last = [module for module in network.modules() if isinstance(module, nn.Linear)][-1]
    nn.init.uniform_(last.weight, -bound, bound)
    nn.init.uniform_(last.bias, -bound, bound)


class _FlockPolicyMixin(BasePolicy):
    """What the policies below share: :class:`FlockCNN`, :class:`ActionLayerCritic` and small output layers."""

    critic_kwargs: dict[str, Any]

    def __init__(
        self,
        *args: Any,
        action_layer: int = 32,
        final_init: float | None = 3e-3,
        features_extractor_class: type[BaseFeaturesExtractor] = FlockCNN,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        **kwargs: Any,
    ) -> None:
        self._action_layer_kwargs: dict[str, Any] = {"action_layer": action_layer, "final_init": final_init}
        super().__init__(
            *args,
            features_extractor_class=features_extractor_class,
            net_arch=[64] if net_arch is None else net_arch,
            **kwargs,
        )

    def set_training_mode(self, mode: bool) -> None:
        """As SB3's, which visits every module at every prediction: only where the mode changes."""
        if self.training != mode:
            super().set_training_mode(mode)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        actor = super().make_actor(features_extractor)  # type: ignore[misc]
        init_output_layer(actor.mu, self._action_layer_kwargs["final_init"])
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ActionLayerCritic:
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return ActionLayerCritic(**critic_kwargs, **self._action_layer_kwargs).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._action_layer_kwargs}


class FlockPolicy(_FlockPolicyMixin, TD3Policy):
    """The paper's networks for DDPG and TD3 (section IV-C, Fig. 2).

    Actor: :class:`FlockCNN`, ``net_arch`` (the last hidden layer), action bound and bias (SB3 scales [-1, 1] to the action
    space). Critic: a separate :class:`FlockCNN`, the action layer, their concatenation, ``net_arch``, one value.

    :param action_layer: width of the critic's hidden layer for the action
    :param final_init: bound of the uniform initialization of the output layers; ``None`` keeps torch's own
    :param net_arch: widths behind the extractor; the default ``[64]`` is the state path's fourth hidden layer
    :param action_bound: ``"inverting"`` (:class:`InvertingBound`) or ``"tanh"``

    The other parameters are those of SB3's ``TD3Policy``.
    """

    def __init__(self, *args: Any, action_bound: str = "inverting", **kwargs: Any) -> None:
        self.action_bound = action_bound
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        actor = super().make_actor(features_extractor)
        if self.action_bound == "inverting":
            actor.mu[-1] = InvertingBound()
        return actor

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "action_bound": self.action_bound}


class FlockSACPolicy(_FlockPolicyMixin, SACPolicy):
    """:class:`FlockPolicy` for SAC: the same parts, with SAC's stochastic actor."""
