import json
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch as th

from sb3_flock import load_policy, train
from sb3_flock.cli import main
from sb3_flock.deploy import onnx_export
from sb3_flock.deploy.onnx_check import random_sample_inputs
from sb3_flock.deploy.onnx_export import INPUTS, PREVIOUS_INPUTS, TOLERANCE, OnnxPolicy, export, metadata_of
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sim import observation
from sb3_flock.sim.observation import Channel, register_channel
from tests.helpers import quiet, tiny


@pytest.fixture(scope="module")
def policy():
    """Without the filter, so that the graph is that of the network alone."""
    shipped = load_policy("ddpg")
    return replace(shipped, config=shipped.config.replace(scenario=shipped.scenario.replace(safety_filter="off")))


@pytest.fixture(scope="module")
def exported(policy, tmp_path_factory):
    return export(policy, tmp_path_factory.mktemp("onnx") / "policy.onnx", n_samples=200)


def act(path, *sample):
    session = onnxruntime.InferenceSession(path)
    return session.run(None, dict(zip(INPUTS, sample, strict=True)))[0]


def test_the_graph_acts_as_predict_does(exported, policy):
    assert exported.n_samples == 200
    assert exported.difference < TOLERANCE
    session = onnxruntime.InferenceSession(exported.path)
    high = np.array([0.15, np.pi])
    for sample, expected in random_sample_inputs(policy.scenario, 200, seed=7):
        (action,) = session.run(None, sample)
        np.testing.assert_allclose(action / high, policy.predict(expected)[0] / high, atol=1e-5)


def test_bodies_out_of_range_are_ignored(exported):
    near, waypoint = np.array([[0.08, 0.05]]), np.array([0.2, 0.1])
    alone = act(exported.path, near, np.zeros((0, 2)), waypoint)
    crowd = act(exported.path, np.array([[0.08, 0.05], [0.2, 0.0], [0.0, 0.151]]), np.array([[0.0, 0.41]]), waypoint)
    np.testing.assert_array_equal(alone, crowd)
    assert np.abs(act(exported.path, near[:0], np.zeros((0, 2)), waypoint) - alone).max() > 1e-3


def test_the_file_holds_what_a_vehicle_needs(exported):
    session = onnxruntime.InferenceSession(exported.path)
    assert [(part.name, part.shape[-1], part.type) for part in session.get_inputs()] == [
        (name, 2, "tensor(double)") for name in INPUTS
    ]
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["sb3_flock"])
    assert metadata["link_range"] == 0.15
    assert metadata["time_step"] == 0.1
    assert metadata["policy"] == "ddpg.zip"
    assert "body frame" in metadata["inputs"]
    assert "filter" not in json.dumps(metadata)  # it is off


@pytest.mark.parametrize(
    "changes",
    [
        {"algo": "sac"},
        {"algo": "td3", "network.action_bound": "tanh", "scenario.n_anchors": 15},
        {"motion_lag": 0.2},
        {"motion_lag": 0.2, "shared_detections": True, "obstacle_radius": 0.35},
        {"motion_lag": 2.0, "obstacle_starts": [[0.5, 0.5]], "sensors.delay": 0.2},
    ],
)
def test_other_algorithms_networks_and_observations(tmp_path, changes):
    result = train(tiny(tmp_path, **changes), quiet())
    done = export(load_policy(result.folder / "final_model.zip"), tmp_path / "other.onnx", n_samples=50)
    assert done.difference < TOLERANCE


def test_the_graph_with_motion_channels_takes_the_previous_measurement(tmp_path):
    result = train(tiny(tmp_path, motion_lag=0.2, safety_filter="off"), quiet())
    path = tmp_path / "policy.onnx"
    export(load_policy(result.folder / "final_model.zip"), path, n_samples=5)
    session = onnxruntime.InferenceSession(path)
    assert [part.name for part in session.get_inputs()] == [*INPUTS, *PREVIOUS_INPUTS]
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["sb3_flock"])
    assert metadata["motion_lag"] == 0.2
    assert "previous_..." in metadata["inputs"]
    near, waypoint = np.array([[0.08, 0.05]]), np.array([0.2, 0.1])
    still = {"neighbors": near, "obstacles": near[:0], "waypoint": waypoint}
    still |= {f"previous_{name}": positions for name, positions in still.items()} | {"ego_motion": np.zeros(3)}
    (at_rest,) = session.run(None, still)
    (approaching,) = session.run(None, {**still, "previous_neighbors": near + 0.03})
    (unseen,) = session.run(None, {**still, "previous_neighbors": np.array([[0.08, 0.05], [0.2, 0.0]])})
    assert np.abs(approaching - at_rest).max() > 1e-6
    np.testing.assert_array_equal(unseen, at_rest)


def test_a_graph_that_acts_otherwise_is_not_written(policy, tmp_path, monkeypatch):
    right = OnnxPolicy.forward

    def wrong(self, neighbors, obstacles, waypoint):
        return right(self, neighbors, obstacles, waypoint) + th.tensor([0.0, 1e-3])

    monkeypatch.setattr(OnnxPolicy, "forward", wrong)
    with pytest.raises(RunError, match="differs from the policy by 0.00016 of the range"):
        export(policy, tmp_path / "policy.onnx", n_samples=3)
    assert not list(tmp_path.iterdir())


def test_with_a_tracker_the_graph_is_the_same_and_the_file_says_that_it_takes_estimates(policy):
    tracked = policy.scenario.replace(tracker={"enabled": True, "assumed_noise": 0.05})
    for (inputs, shown), (others, other) in zip(
        random_sample_inputs(policy.scenario, 3, 0), random_sample_inputs(tracked, 3, 0), strict=True
    ):
        np.testing.assert_array_equal(shown, other)
        assert {name: value.tolist() for name, value in inputs.items()} == {n: v.tolist() for n, v in others.items()}
    assert "a tracker in front of this file" in metadata_of(policy, tracked)["estimates"]
    assert "estimates" not in metadata_of(policy, policy.scenario)


def test_mistakes_are_one_line(policy, tmp_path):
    with pytest.raises(SettingsError, match=f"there is no folder {tmp_path / 'no'}$"):
        export(policy, tmp_path / "no" / "policy.onnx")
    with pytest.raises(SettingsError, match="DDPG, TD3 or SAC is needed, not object"):
        OnnxPolicy(object(), policy.scenario)


def test_the_command_prints_the_difference_and_the_time(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(onnx_export, "compare", lambda *_: (3e-7, 1.2e-4))
    assert main(["export", "ddpg", str(tmp_path / "policy.onnx")]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{tmp_path / 'policy.onnx'}\n"
    difference = "differs from the policy by at most 3e-07 of the range over 1000 sample inputs"
    assert printed.err == f"{difference}; 0.120 ms a decision (median, one core)\n"
    assert main(["export", "ddpg", str(tmp_path / "no" / "policy.onnx")]) == 2
    assert capsys.readouterr().err.endswith(f"there is no folder {tmp_path / 'no'}\n")


@pytest.fixture
def _channel_ahead():
    """A further channel: the neighbors ahead of the vehicle, within half of the link range to its sides."""
    before = dict(observation.CHANNELS)

    def is_ahead(positions):
        return (positions[:, 0] > 0) & (abs(positions[:, 1]) < 0.08)

    register_channel(Channel("ahead", "neighbors", lambda settings: settings.link_range, is_ahead))
    register_channel(Channel("goal_left", "waypoint", lambda settings: 0.1, lambda positions: positions[:, 1] > 0))
    yield
    observation.CHANNELS.clear()
    observation.CHANNELS.update(before)


class Observer(th.nn.Module):
    """An actor whose action is its observation."""

    def forward(self, observations):
        return observations


@pytest.mark.usefixtures("_channel_ahead")
@pytest.mark.parametrize("motion_lag", [0.0, 0.2])
def test_extra_channels_in_the_graph_equal_the_numpy_observation(policy, motion_lag):
    scenario = policy.scenario.replace(extra_channels=("ahead", "goal_left"), motion_lag=motion_lag)
    module = OnnxPolicy(policy.policy, scenario)
    module.actor, module.low, module.high = Observer(), th.tensor(-1.0), th.tensor(1.0)  # the output is the observation
    shown, selects = np.zeros(scenario.observation_shape[0], bool), False
    for sample, expected in random_sample_inputs(scenario, 100, seed=3):
        assert expected.shape == scenario.observation_shape
        computed = module(*(th.from_numpy(sample[name]) for name in onnx_export.inputs_of(scenario)))
        np.testing.assert_allclose(computed.numpy(), expected, atol=1e-5)
        shown |= np.abs(expected).max((1, 2)) > 0.1
        selects |= not np.array_equal(expected[3], expected[0])
    assert shown.all()
    assert selects


@pytest.mark.usefixtures("_channel_ahead")
def test_a_policy_with_an_extra_channel_is_exported(tmp_path):
    result = train(tiny(tmp_path, extra_channels=["ahead"], motion_lag=0.2), quiet())
    loaded = load_policy(result.folder / "final_model.zip")
    assert loaded.scenario.observation_shape == (8, 11, 11)
    assert export(loaded, tmp_path / "policy.onnx", n_samples=50).difference < TOLERANCE
