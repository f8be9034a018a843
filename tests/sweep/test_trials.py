"""What one trial reports, without Ray around it."""

import numpy as np
import pytest

pytest.importorskip("ray")
from sb3_flock.pretrained import shipped_policies
from sb3_flock.rl.callbacks import DivergedError
from sb3_flock.sweep import trials
from sb3_flock.sweep.config import load_sweep
from tests.helpers import TINY


@pytest.fixture
def reported(monkeypatch, tmp_path):
    """What a trial reports to Ray, in a working directory of its own."""
    rows = []
    monkeypatch.setattr(trials.tune, "report", lambda row, checkpoint=None: rows.append((row, checkpoint)))
    monkeypatch.setattr(trials.tune, "get_checkpoint", lambda: None)
    monkeypatch.chdir(tmp_path)
    return rows


def sweep(text, **changes):
    return load_sweep("", TINY | {"n_test_episodes": 2}, text=text, **changes).model_dump(mode="json")


def test_a_training_reports_its_evaluations_its_checkpoints_and_its_test(reported, tmp_path):
    trials.train_trial({"seed": 3}, sweep("grid: {seed: [3]}"))
    last, checkpoint = reported[-1]
    assert (last["status"], last["timesteps"], last["total_timesteps"]) == ("done", 300, 300)
    assert set(last["test"]) > {"tracking_error", "score"}
    assert checkpoint is not None
    assert sum(saved is not None for _, saved in reported[:-1]) >= 1
    assert {row["score"] for row, _ in reported[:-1]} > {float("inf")}
    assert not (tmp_path / "runs").exists()  # Ray has the copy


def test_evaluations_of_an_earlier_version_may_lack_a_metric(tmp_path):
    np.savez(tmp_path / "evaluations.npz", tracking_error=[0.3, 0.2], score=[0.5, 0.4], seconds=[60.0, 120.0])
    reports = trials.Reports(1000)
    reports.read(tmp_path)
    assert reports.row == {"timesteps": 0, "total_timesteps": 1000, "tracking_error": 0.2, "score": 0.4, "minutes": 2.0}


@pytest.mark.parametrize(
    ("point", "status", "why"),
    [
        ({"scenario.arena": 0.01}, "refused", "n_vehicles = 3: no start"),
        ({"scenario.arena": 1.0}, "diverged", "loss is nan"),
    ],
)
def test_an_error_that_would_repeat_is_a_status(point, status, why, reported, monkeypatch):
    if status == "diverged":

        def diverge(*_, **__):
            raise DivergedError("loss is nan")

        monkeypatch.setattr(trials, "train", diverge)
    trials.train_trial(point, sweep("grid: {scenario.arena: [1.0, 0.01]}"))
    row, _ = reported[-1]
    assert (row["status"], row["score"]) == (status, float("inf"))
    assert why in row["why"]


def test_any_other_error_is_for_ray_to_try_again(reported, monkeypatch):
    def fail(*_, **__):
        raise OSError("the disk is gone")

    monkeypatch.setattr(trials, "train", fail)
    with pytest.raises(OSError, match="the disk is gone"):
        trials.train_trial({"seed": 0}, sweep("grid: {seed: [0]}"))
    assert not any("status" in row for row, _ in reported)


def test_a_policy_is_evaluated_from_the_bytes_of_its_zip(reported):
    config = load_sweep("", text="grid: {scenario.n_vehicles: [2]}", policy="ddpg", episodes=3)
    zipped = shipped_policies()["ddpg"].read_bytes()
    trials.evaluate_trial({"scenario.n_vehicles": 2}, config.model_dump(mode="json"), zipped)
    ((row, _),) = reported
    assert row["status"] == "done"
    assert 0 < row["test"]["tracking_error"] < 0.2
    trials.evaluate_trial({"scenario.arena": 0.001}, config.model_dump(mode="json"), zipped)
    assert reported[-1][0]["status"] == "refused"
