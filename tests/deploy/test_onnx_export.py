import json

import numpy as np
import onnxruntime
import pytest
import torch as th

from sb3_flock import load_policy, train
from sb3_flock.cli import main
from sb3_flock.deploy.onnx_export import EARLIER_INPUTS, INPUTS, TOLERANCE, OnnxPolicy, export, random_sample_inputs
from sb3_flock.rl import onboard
from sb3_flock.settings import RunError, SettingsError
from tests.helpers import quiet, tiny


@pytest.fixture(scope="module")
def policy():
    return load_policy("ddpg-3v1o")


@pytest.fixture(scope="module")
def exported(policy, tmp_path_factory):
    return export(policy, tmp_path_factory.mktemp("onboard") / "policy.onnx", situations=200)


def decide(path, *situation):
    session = onnxruntime.InferenceSession(path)
    return session.run(None, dict(zip(INPUTS, situation, strict=True)))[0]


def test_it_decides_as_predict_does(exported, policy):
    assert exported.situations == 200
    assert exported.difference < TOLERANCE
    session = onnxruntime.InferenceSession(exported.path)
    high = np.array([0.15, np.pi])
    for situation, tensor in random_sample_inputs(policy.scenario, 200, seed=7):
        (action,) = session.run(None, situation)
        np.testing.assert_allclose(action / high, policy.predict(tensor)[0] / high, atol=1e-5)


def test_situations_are_of_all_kinds(policy):
    situations = [situation for situation, _ in random_sample_inputs(policy.scenario, 200, seed=0)]
    assert {len(situation["neighbors"]) for situation in situations} == set(range(12))
    assert {len(situation["obstacles"]) for situation in situations} == set(range(6))
    nearest = [np.linalg.norm(situation["neighbors"], axis=-1).min(initial=9) for situation in situations]
    assert min(nearest) < policy.scenario.link_range < max(nearest)


def test_what_is_out_of_range_does_not_count(exported):
    near, waypoint = np.array([[0.08, 0.05]]), np.array([0.2, 0.1])
    alone = decide(exported.path, near, np.zeros((0, 2)), waypoint)
    crowd = decide(exported.path, np.array([[0.08, 0.05], [0.2, 0.0], [0.0, 0.151]]), np.array([[0.0, 0.26]]), waypoint)
    np.testing.assert_array_equal(alone, crowd)
    assert np.abs(decide(exported.path, near[:0], np.zeros((0, 2)), waypoint) - alone).max() > 1e-3


def test_the_file_tells_what_a_vehicle_needs(exported):
    session = onnxruntime.InferenceSession(exported.path)
    assert [(part.name, part.shape[-1], part.type) for part in session.get_inputs()] == [
        (name, 2, "tensor(double)") for name in INPUTS
    ]
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["sb3_flock"])
    assert metadata["link_range"] == 0.15
    assert metadata["time_step"] == 0.1
    assert metadata["policy"] == "ddpg-3v1o.zip"
    assert "body frame" in metadata["inputs"]


@pytest.mark.parametrize(
    "changes",
    [
        {"algo": "sac"},
        {"algo": "td3", "network.action_bound": "tanh", "scenario.n_anchors": 15},
        {"motion_lag": 0.2},
        {"motion_lag": 2.0, "obstacle_starts": [[0.5, 0.5]], "sensors.delay": 0.2},
    ],
)
def test_other_algorithms_networks_and_tensors(tmp_path, changes):
    result = train(tiny(tmp_path, **changes), quiet())
    done = export(load_policy(result.folder / "final_model.zip"), tmp_path / "other.onnx", situations=50)
    assert done.difference < TOLERANCE


def test_a_second_look_counts_aboard(tmp_path):
    result = train(tiny(tmp_path, motion_lag=0.2), quiet())
    path = tmp_path / "policy.onnx"
    export(load_policy(result.folder / "final_model.zip"), path, situations=5)
    session = onnxruntime.InferenceSession(path)
    assert [part.name for part in session.get_inputs()] == [*INPUTS, *EARLIER_INPUTS]
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["sb3_flock"])
    assert metadata["motion_lag"] == 0.2
    assert "..._before" in metadata["inputs"]
    near, waypoint = np.array([[0.08, 0.05]]), np.array([0.2, 0.1])
    still = {"neighbors": near, "obstacles": near[:0], "waypoint": waypoint}
    still |= {f"{name}_before": positions for name, positions in still.items()} | {"moved": np.zeros(3)}
    (standing,) = session.run(None, still)
    (coming,) = session.run(None, {**still, "neighbors_before": near + 0.03})
    (unseen,) = session.run(None, {**still, "neighbors_before": np.array([[0.08, 0.05], [0.2, 0.0]])})
    assert np.abs(coming - standing).max() > 1e-6
    np.testing.assert_array_equal(unseen, standing)


def test_a_graph_that_decides_otherwise_is_not_written(policy, tmp_path, monkeypatch):
    right = OnnxPolicy.forward

    def wrong(self, neighbors, obstacles, waypoint):
        return right(self, neighbors, obstacles, waypoint) + th.tensor([0.0, 1e-3])

    monkeypatch.setattr(OnnxPolicy, "forward", wrong)
    with pytest.raises(RunError, match="differs from the policy by 0.00016 of the range"):
        export(policy, tmp_path / "policy.onnx", situations=3)
    assert not list(tmp_path.iterdir())


def test_mistakes_are_one_line(tmp_path, capsys):
    assert main(["export", "ddpg-3v1o", str(tmp_path / "no" / "policy.onnx")]) == 2
    assert capsys.readouterr().err.endswith(f"there is no folder {tmp_path / 'no'}\n")
    with pytest.raises(SettingsError, match="DDPG, TD3 or SAC is needed, not object"):
        OnnxPolicy(object(), load_policy("ddpg-3v1o").scenario)


def test_the_command_tells_the_difference_and_the_time(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(onboard, "_compare", lambda *_: (3e-7, 1.2e-4))
    assert main(["export", "ddpg-3v1o", str(tmp_path / "policy.onnx")]) == 0
    metadata = capsys.readouterr()
    assert metadata.out == f"{tmp_path / 'policy.onnx'}\n"
    assert (
        metadata.err
        == "differs from the policy by at most 3e-07 of the range in 1000 situations; 0.120 ms a decision (median, one core)\n"
    )
