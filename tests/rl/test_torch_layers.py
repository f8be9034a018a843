import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_flock import FlockCNN, make_vec_env
from sb3_flock.settings import SettingsError


def space(side=11, channels=3):
    return spaces.Box(0.0, 1.0, (channels, side, side), np.float32)


@pytest.mark.parametrize(
    ("side", "kwargs"), [(11, {}), (7, {"stride": 1}), (21, {"channels": (4, 8)}), (11, {"layer_norm": False})]
)
def test_features_have_the_stated_shape(side, kwargs):
    extractor = FlockCNN(space(side), features_dim=24, **kwargs)
    assert extractor(th.rand(5, 3, side, side)).shape == (5, 24)
    assert extractor.features_dim == 24


def test_by_default_two_convolutions_and_one_dense_layer_with_layer_norm():
    extractor = FlockCNN(space())
    kinds = [type(module).__name__ for module in extractor.modules() if not list(module.children())]
    assert kinds == ["Conv2d", "ReLU", "Conv2d", "ReLU", "_FlattenByAnchor", "Linear", "LayerNorm", "ReLU"]
    assert not any(isinstance(module, th.nn.LayerNorm) for module in FlockCNN(space(), layer_norm=False).modules())


@pytest.mark.parametrize(
    ("side", "kwargs"),
    [(11, {}), (7, {"stride": 1}), (12, {"channels": (4, 6, 5), "kernel_size": 2}), (9, {"channels": (4,)})],
)
def test_forward_and_backward_equal_torchs_own_layers(side, kwargs):
    extractor = FlockCNN(space(side), features_dim=24, **kwargs)
    observations = th.randn(5, 3, side, side, requires_grad=True)
    ours, torchs = extractor(observations), extractor.dense(extractor.cnn(observations))
    th.testing.assert_close(ours, torchs)
    th.testing.assert_close(extractor(extractor.patches(observations)), ours)
    leaves, weights = [observations, *extractor.parameters()], th.randn(5, 24)
    for one, other in zip(th.autograd.grad(ours, leaves, weights), th.autograd.grad(torchs, leaves, weights), strict=True):
        th.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
        assert one.stride() == other.contiguous().stride()


def test_every_anchor_has_a_gradient():
    extractor = FlockCNN(space())
    observation = th.rand(1, 3, 11, 11, requires_grad=True)
    extractor(observation).sum().backward()
    assert (observation.grad != 0).all()


def test_an_observation_too_small_or_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="do not fit an observation of"):
        FlockCNN(space(3))
    with pytest.raises(SettingsError, match=r"^FlockCNN needs observations of shape \(channels, l, l\), not \(5,\)$"):
        FlockCNN(spaces.Box(0.0, 1.0, (5,), np.float32))
    for shape in ((11, 11, 3), (3, 11, 44), (3, 44, 11)):
        with pytest.raises(SettingsError, match=r"not \(\d+, \d+, \d+\); VecFrameStack needs channels_order='first'$"):
            FlockCNN(spaces.Box(0.0, 1.0, shape, np.float32))


def test_stacked_frames_are_refused_or_seen_whole():
    kwargs = {"policy_kwargs": {"features_extractor_class": FlockCNN}, "buffer_size": 10, "device": "cpu"}
    with pytest.raises(SettingsError, match=r"not \(3, 11, 44\); VecFrameStack needs channels_order='first'"):
        DDPG("MlpPolicy", VecFrameStack(make_vec_env(n_flocks=1, seed=0), 4), **kwargs)
    env = VecFrameStack(make_vec_env(n_flocks=1, seed=0), 4, channels_order="first")
    extractor = DDPG("MlpPolicy", env, **kwargs).actor.features_extractor
    observation = th.from_numpy(env.reset()).requires_grad_()
    extractor(observation).sum().backward()
    assert observation.shape == (3, 12, 11, 11)
    assert (observation.grad != 0).any(dim=(0, 2, 3)).all()


def test_the_extractor_in_plain_sb3():
    env = make_vec_env(n_flocks=1, seed=0)
    model = DDPG("MlpPolicy", env, policy_kwargs={"features_extractor_class": FlockCNN}, buffer_size=10, device="cpu")
    assert isinstance(model.actor.features_extractor, FlockCNN)
    assert model.predict(env.reset())[0].shape == (3, 2)
