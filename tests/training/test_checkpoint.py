import csv
import functools
import io
import platform
import shutil
import zipfile
from importlib.metadata import version

import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.load import PolicyError, checkpoint_paths
from sb3_flock.serialization.yaml_io import load_config, to_yaml
from sb3_flock.settings import SettingsError, resolve_path
from sb3_flock.sim.backend import compiled
from sb3_flock.training.checkpoint import LoadedCheckpoint, reproducibility_warnings
from sb3_flock.training.train import resume, train
from tests.helpers import quiet, tiny, training_state


class PowerError(Exception):
    pass


class PowerFails(BaseCallback):
    """The power fails after so many transitions."""

    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps >= self.steps:
            raise PowerError
        return True


LONG = {"scenario.max_cycles": 40, "save_freq": 120, "eval_freq": 180, "total_timesteps": 600, "buffer_size": 330}

RANGES = {
    "actuators.speed_lag": (0.0, 0.3),
    "actuators.slip": (0.0, 0.1),
    "sensors.delay": (0.0, 0.3),
    "sensors.dropout": (0, 1),
}


@pytest.mark.parametrize(
    ("algo", "changes"),
    [
        ("ddpg", {}),
        ("ddpg-sb3", {}),
        ("td3", {"n_steps": 3}),
        ("sac", {}),
        ("ddpg", {"buffer_size": 10_000}),
        ("ddpg", {"motion_lag": 0.4, "expert": "orca", "expert_fraction": 0.5}),
        ("ddpg", {"expert": "orca", "bc_coef": 1.0, "expert_fraction": 0.3}),
        ("ddpg", {"expert": "mpc", "bc_coef": 1.0, "expert_fraction": 0.3}),
        ("ddpg", {"expert": "olfati-saber", "expert_fraction": 0.9, "train_env.flock_sizes": [1, 2]}),
        ("ddpg", {"expert": "orca", "bc_coef": 1.0, "motion_lag": 0.4, "actuators.turn_lag": 0.1, "randomization": RANGES}),
        ("ddpg", {"motion_lag": 0.4, "tracker.enabled": True, "shared_motion": True, "randomization": RANGES}),
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one_to_the_last_bit(tmp_path, algo, changes):
    one = train(tiny(tmp_path / "a", algo=algo, **{**LONG, **changes}), quiet())
    config = tiny(tmp_path / "b", algo=algo, **{**LONG, **changes})
    folder = tmp_path / "b" / "runs" / one.folder.name
    for steps in (200, 460):
        proceed = functools.partial(resume, folder) if folder.exists() else functools.partial(train, config)
        with pytest.raises(PowerError):
            proceed(quiet(), callbacks=[PowerFails(steps)])
        np.random.seed(steps)  # noqa: NPY002 - another process would have other streams
        th.manual_seed(steps)
    other = resume(folder, quiet())
    ours, theirs = training_state(one), training_state(other)
    assert ours.keys() == theirs.keys()
    assert len(ours) > 100
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)


def test_a_complete_run_continues_only_with_more_transitions(tmp_path):
    first = train(tiny(tmp_path), quiet())
    for changes in (None, {"total_timesteps": 100}, {"total_timesteps": 300}):
        with pytest.raises(SettingsError, match="a larger total_timesteps"):
            resume(first.folder, quiet(), changes)
    with pytest.raises(SettingsError, match="seed cannot change"):
        resume(first.folder, quiet(), {"seed": 1})
    with pytest.raises(SettingsError, match="not a run folder"):
        resume(tmp_path, quiet())
    half_written = first.folder / ".rl_model_9_steps.zip.tmp"
    half_written.write_bytes(b"PK")
    longer = resume(first.folder, quiet(), {"total_timesteps": 420}, command=["sb3-flock", "train", "--resume"])
    assert longer.model.num_timesteps == 420
    assert not half_written.exists()
    assert load_config(TrainingConfig, first.folder / "config.yaml").total_timesteps == 420
    assert np.load(first.folder / "evaluations.npz")["timesteps"].tolist() == [120, 240, 300, 360, 420]
    assert (first.folder / "command.txt").read_text().endswith("\nsb3-flock train --resume\n")
    with open(first.folder / "progress.csv") as file:
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(file)]
    assert steps == sorted(steps)
    assert {120, 300, 420} <= set(steps)


def test_another_runtime_is_reported(ended):
    checkpoint = LoadedCheckpoint(checkpoint_paths(ended.folder)[-1], 10**9)
    assert reproducibility_warnings(checkpoint, ended.config) == ""
    info = checkpoint.state["runtime_info"]
    assert info["numba"] == (version("numba") if compiled() else "none")
    if platform.system() == "Linux" and platform.machine() == "x86_64":
        assert len(info["processor"].split()) >= 3  # vendor, family, model
    info["torch"] = "1.0"
    assert "; not bit-exact: torch 1.0 then, " in reproducibility_warnings(checkpoint, ended.config)
    assert "worker processes start new episodes" in reproducibility_warnings(checkpoint, ended.config.replace(num_cpus=2))


def test_a_run_without_a_checkpoint_is_resumed_from_its_start(tmp_path, ended):
    folder = shutil.copytree(ended.folder, tmp_path / "run")
    for path in (*checkpoint_paths(folder), folder / "final_model.zip"):
        path.unlink()
    again = resume(folder, quiet())
    assert again.model.num_timesteps == ended.model.num_timesteps
    for ours, theirs in zip(again.model.policy.parameters(), ended.model.policy.parameters(), strict=True):
        assert th.equal(ours, theirs)


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """A training of :data:`TINY` that has ended."""
    return train(tiny(tmp_path_factory.mktemp("ended")), quiet())


@pytest.mark.parametrize(
    "edit",
    [{"gamma": 0.5}, {"reward.lambda_": 0.1}, {"seed": 7}, {"algo": "td3"}, {"features_dim": 24}, {"safety_filter": "off"}],
)
def test_an_edited_config_that_changes_what_is_learned_is_refused(tmp_path, ended, edit):
    folder = shutil.copytree(ended.folder, tmp_path / "run")
    ((name, value),) = edit.items()
    whole = ".".join(resolve_path(TrainingConfig, name))
    edited = load_config(TrainingConfig, overrides={**edit, "total_timesteps": 420}, base=ended.config)
    (folder / "config.yaml").write_text(to_yaml(edited))
    newest = checkpoint_paths(folder)[-1].name
    with pytest.raises(SettingsError, match=rf"config.yaml: {whole} = {value} \(.* in {newest}\): these cannot change"):
        resume(folder, quiet())
    assert load_config(TrainingConfig, folder / "config.yaml") == edited
    assert checkpoint_paths(folder)[-1].name == newest


def test_a_resumed_run_says_what_changed_since_its_checkpoint(tmp_path):
    first = train(tiny(tmp_path), quiet())
    edited = load_config(TrainingConfig, overrides={"n_test_episodes": 3, "output_dir": "elsewhere"}, base=first.config)
    (first.folder / "config.yaml").write_text(to_yaml(edited))
    shown = io.StringIO()
    resume(first.folder, Console(file=shown, width=300), {"total_timesteps": 420})
    tests = first.config.n_test_episodes
    line = f"after 300 of 420 transitions; total_timesteps = 420 (300 before); n_test_episodes = 3 ({tests} before)\n"
    assert line in shown.getvalue()


def test_a_checkpoint_that_does_not_fit_its_own_config_is_refused(ended):
    checkpoint = LoadedCheckpoint(checkpoint_paths(ended.folder)[-1], 10**9)
    del checkpoint.state["model"]["replay"]
    with pytest.raises(PolicyError, match=r"not a checkpoint of this run's config \('replay'\)"):
        checkpoint.restore_model(ended.model)


def test_what_all_parts_of_a_checkpoint_unpack_to_is_bounded(tmp_path):
    """Twenty arrays, each below the limit, that are packed to a thousandth."""
    path, limit = tmp_path / "rl_model_1_steps.zip", 10**6
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("training.json", "{}")
        for i in range(20):
            archive.writestr(f"training/part{i}.npy", bytes(limit // 10))
    with pytest.raises(
        PolicyError, match=rf"damaged or not a checkpoint \(it unpacks to \d+ bytes: at most {limit} are read\)"
    ):
        LoadedCheckpoint(path, limit)
