import numpy as np
import pytest

from sb3_flock.deploy.onnx_check import decide, random_sample_inputs
from sb3_flock.sim import Scenario


def test_sample_inputs_have_all_numbers_of_bodies_near_and_far():
    samples = [sample for sample, _ in random_sample_inputs(Scenario(), 200, seed=0)]
    assert {len(sample["neighbors"]) for sample in samples} == set(range(12))
    assert {len(sample["obstacles"]) for sample in samples} == set(range(6))
    nearest = [np.linalg.norm(sample["neighbors"], axis=-1).min(initial=9) for sample in samples]
    assert min(nearest) < Scenario().link_range < max(nearest)


@pytest.mark.parametrize("motion_lag", [0.0, 0.2])
def test_a_filter_adds_what_the_neighbors_send_and_changes_nothing_else(motion_lag):
    plain, filtered = (
        [sample for sample, _ in random_sample_inputs(Scenario(motion_lag=motion_lag, safety_filter=level), 20, seed=0)]
        for level in ("off", "announce")
    )
    for without, sample in zip(plain, filtered, strict=True):
        assert set(sample) - set(without) == {"neighbor_headings", "neighbor_announced_speeds"}
        for name in set(sample) - set(without):
            assert len(sample[name]) == len(sample["neighbors"])
        if not motion_lag:  # no step is taken that the filter may change
            for name, values in without.items():
                np.testing.assert_array_equal(sample[name], values)
    announced = np.concatenate([sample["neighbor_announced_speeds"] for sample in filtered])
    assert (announced >= 0).all()
    assert 0 < announced.max() <= 0.15


def test_a_decision_with_announcements_has_two_runs():
    runs = []

    class Session:
        def run(self, names, inputs):
            runs.append((names, inputs["neighbor_announced_speeds"].tolist()))
            return names

    assert decide(Session(), {"neighbor_announced_speeds": np.array([0.1, 0.2])}) == ["action", "announced_speed"]
    assert runs == [(["announced_speed"], [0.0, 0.0]), (["action"], [0.1, 0.2])]
