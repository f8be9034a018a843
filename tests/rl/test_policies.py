import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_flock import FlockCNN, FlockPolicy, FlockSACPolicy
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.rl.policies import InvertingBound
from sb3_flock.rl.registry import flock_policy_kwargs
from sb3_flock.rl.settings import NetworkConfig
from sb3_flock.sim import Scenario

SCENARIO = Scenario()
OBSERVATIONS = th.rand(6, 3, 11, 11, generator=th.Generator().manual_seed(0))
ACTIONS = th.rand(6, 2, generator=th.Generator().manual_seed(1)) * 2 - 1


def build(policy_class=FlockPolicy, **kwargs):
    th.manual_seed(0)
    return policy_class(observation_space(SCENARIO), action_space(SCENARIO), lr_schedule=lambda _: 1e-3, **kwargs)


def sizes(network):
    return [(m.in_features, m.out_features) for m in network.modules() if isinstance(m, nn.Linear)]


def test_the_critics_action_layer_joins_before_the_last_hidden_layer():
    policy = build(n_critics=1, action_layer=16, net_arch=[64])
    assert sizes(policy.critic.action_layers[0]) == [(2, 16)]
    assert sizes(policy.critic.qf0) == [(128 + 16, 64), (64, 1)]
    assert sizes(policy.actor.mu) == [(128, 64), (64, 2)]
    assert isinstance(policy.critic.features_extractor, FlockCNN)
    assert policy.critic.features_extractor is not policy.actor.features_extractor


def test_the_gradient_in_the_action_depends_on_the_state():
    critic = build(n_critics=1, final_init=None).critic
    actions = ACTIONS[:1].expand(6, 2).clone().requires_grad_()  # one action in six states
    critic.q1_forward(OBSERVATIONS * 3, actions).sum().backward()
    assert actions.grad.std(0).min() > 1e-6


def test_q1_is_the_first_networks_value_and_critics_differ():
    critic = build(n_critics=2, final_init=None).critic
    first, second = critic(OBSERVATIONS, ACTIONS)
    th.testing.assert_close(critic.q1_forward(OBSERVATIONS, ACTIONS), first)
    assert not th.allclose(first, second)
    assert first.shape == (6, 1)


def test_a_critic_networks_value_has_gradients_in_its_own_layers_and_the_extractor():
    critic = build(n_critics=2, final_init=None).critic
    critic(OBSERVATIONS, ACTIONS)[1].sum().backward()
    touched = {name for name, p in critic.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}
    assert any(name.startswith("features_extractor") for name in touched)
    assert any(name.startswith("action_layers.1") for name in touched)
    assert any(name.startswith("qf1") for name in touched)
    assert not any(name.startswith(("action_layers.0", "qf0")) for name in touched)


def test_every_parameter_of_the_critic_is_optimized():
    critic = build(n_critics=2).critic
    optimized = {id(p) for group in critic.optimizer.param_groups for p in group["params"]}
    assert optimized == {id(p) for p in critic.parameters()}


def test_small_output_layers_give_the_middle_of_the_action_range_at_the_start():
    plain = build(final_init=3e-3, features_extractor_kwargs={"layer_norm": False})
    np.testing.assert_allclose(plain.predict(OBSERVATIONS.numpy(), deterministic=True)[0], [[0.075, 0.0]] * 6, atol=0.01)
    actions, _ = build(final_init=3e-3).predict(OBSERVATIONS.numpy(), deterministic=True)
    np.testing.assert_allclose(actions / [0.15, 2 * np.pi], [[0.5, 0.0]] * 6, atol=0.005)
    assert max(p.abs().max() for p in build(final_init=3e-3).actor.mu[-2].parameters()) <= 3e-3


def test_actions_stay_in_the_action_space_however_large_the_outputs():
    actions, _ = build(final_init=50.0).predict((OBSERVATIONS * 9).numpy(), deterministic=True)
    assert actions.min(0)[0] >= 0
    assert actions.max(0)[0] <= np.float32(0.15)
    assert np.abs(actions[:, 1]).max() <= np.float32(np.pi)


def test_the_inverting_bound_clamps_and_inverts_outward_gradients_beyond_it():
    raw = th.tensor([-3.0, -1.0, 0.0, 0.5, 1.0, 3.0], requires_grad=True)
    bounded = InvertingBound()(raw)
    assert bounded.tolist() == [-1.0, -1.0, 0.0, 0.5, 1.0, 1.0]
    (raising,) = th.autograd.grad(-bounded.sum(), raw, retain_graph=True)  # descent would raise every output
    assert raising.tolist() == [-1.0, -1.0, -1.0, -1.0, 0.0, 1.0]
    (lowering,) = th.autograd.grad(bounded.sum(), raw)
    assert lowering.tolist() == [-1.0, 0.0, 1.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(("action_bound", "leaves"), [("inverting", True), ("tanh", False)])
def test_an_actor_far_beyond_its_bound_recovers_with_inverting_gradients_but_not_with_a_tanh(action_bound, leaves):
    actor = build(action_bound=action_bound).actor
    th.nn.init.constant_(actor.mu[-2].bias, -20.0)
    optimizer = th.optim.SGD([actor.mu[-2].bias], lr=1.0)
    for _ in range(60):
        loss = (actor(OBSERVATIONS) - 0.5).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (actor(OBSERVATIONS).mean().item() == pytest.approx(0.5, abs=0.1)) == leaves


@pytest.mark.parametrize("policy_class", [FlockPolicy, FlockSACPolicy])
def test_policies_save_and_load(policy_class, tmp_path):
    bound = {"action_bound": "tanh"} if policy_class is FlockPolicy else {}
    policy = build(policy_class, action_layer=16, final_init=9.0, net_arch=[32], n_critics=2, **bound)
    policy.save(tmp_path / "policy.pth")
    loaded = policy_class.load(tmp_path / "policy.pth")
    first, _ = policy.predict(OBSERVATIONS.numpy(), deterministic=True)
    second, _ = loaded.predict(OBSERVATIONS.numpy(), deterministic=True)
    np.testing.assert_array_equal(first, second)
    th.testing.assert_close(policy.critic(OBSERVATIONS, ACTIONS)[1], loaded.critic(OBSERVATIONS, ACTIONS)[1])


def test_the_policy_by_itself_has_the_settings_that_learn():
    policy, defaults = build(), NetworkConfig()
    assert policy.action_bound == "inverting"
    assert isinstance(policy.actor.mu[-1], InvertingBound)
    assert sizes(policy.actor.mu) == [(defaults.features_dim, *defaults.net_arch), (*defaults.net_arch, 2)]
    for network in (policy.actor, policy.critic, build(FlockSACPolicy).actor):
        assert [type(module) for module in network.features_extractor.dense] == [nn.Linear, nn.LayerNorm, nn.ReLU]
    # All but SB3's default number of critics and the optimizer's kind is what a config's networks have.
    built = build(**{**flock_policy_kwargs(defaults.replace(n_critics=2)), "optimizer_kwargs": {}})
    for (name, value), (same, expected) in zip(policy.state_dict().items(), built.state_dict().items(), strict=True):
        assert name == same
        th.testing.assert_close(value, expected, rtol=0, atol=0)


@pytest.mark.parametrize("policy_class", [FlockPolicy, FlockSACPolicy])
def test_the_mode_reaches_every_module_and_costs_nothing_where_it_is_set(policy_class, monkeypatch):
    policy = build(policy_class)
    for mode in (False, True):
        policy.set_training_mode(mode)
        assert {module.training for network in (policy.actor, policy.critic) for module in network.modules()} == {mode}
    policy.set_training_mode(False)
    monkeypatch.setattr(policy.actor, "set_training_mode", None)  # calling it would be an error
    policy.predict(OBSERVATIONS.numpy())
