"""Every example of docs/extending runs, shortened by its own argument, and has its effect."""

import csv
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from sb3_contrib import TQC
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import FlockCNN, load_policy, resume, train
from sb3_flock.rl.registry import ALGORITHMS, AlgorithmSpec, extractor_kwargs
from sb3_flock.sim.reward import EXTRA_TERMS
from tests.helpers import quiet, run_example, tiny, training_state

ROOT = Path(__file__).parents[1]


def run(name, *arguments, cwd):
    return run_example(f"extend_{name}.py", *arguments, cwd=cwd)


def last_logged(folder, key):
    """The last value of a log key in a run folder's progress.csv."""
    (progress,) = folder.glob("runs/*/progress.csv")
    with open(progress, newline="") as file:
        return [float(row[key]) for row in csv.DictReader(file) if row[key]][-1]


class Interruption(BaseCallback):
    """Ends a training after its first checkpoint."""

    def _on_step(self):
        if self.num_timesteps >= 200:
            raise KeyboardInterrupt
        return True


def test_a_reward_term_is_in_the_infos_the_log_and_the_config(tmp_path):
    output = run("reward", 4100, cwd=tmp_path)
    spacing = [float(value) for value in re.findall(r"'spacing': (-?[\d.]+)", output)]
    assert len(spacing) == 3
    assert min(spacing) < 0
    assert max(spacing) <= 0
    assert last_logged(tmp_path, "flock/spacing") < 0
    assert "extra_terms: {spacing: 20.0}" in next(tmp_path.glob("runs/*/config.yaml")).read_text()
    assert output.count("mean distance of linked vehicles") == 2
    assert "spacing" not in EXTRA_TERMS  # registration lasts for one process


def test_a_metric_is_a_row_of_the_table(tmp_path):
    output = run("metric", 20, cwd=tmp_path)
    times = [float(value) for value in re.findall(r"arrival_time +([\d.]+)", output)]
    assert len(times) == 2
    assert all(0.1 <= time <= 20 for time in times)


def test_a_channel_is_in_the_observation_and_in_the_exported_graph(tmp_path):
    output = run("channel", 300, cwd=tmp_path)
    assert "observations of shape (4, 11, 11)" in output
    assert float(re.search(r"by at most (\S+) of", output)[1]) < 1e-5
    assert (tmp_path / "extend_channel.onnx").stat().st_size > 10_000
    assert (tmp_path / "extend_channel.png").read_bytes().startswith(b"\x89PNG")


def test_a_controller_has_a_name_and_is_an_expert(tmp_path):
    output = run("controller", 4100, cwd=tmp_path)
    errors = {name: float(error) for name, error in re.findall(r"(\S+): tracking error ([\d.]+) m", output)}
    assert list(errors) == ["potential-field", "orca", "student"]
    assert errors["potential-field"] < 0.1
    assert 0 < last_logged(tmp_path, "train/bc_loss") < 1


def test_an_algorithm_of_sb3_contrib_trains_saves_loads_and_evaluates(tmp_path):
    output = run("algorithm", 4100, cwd=tmp_path)
    transitions = int(re.search(r"tqc_3v1o_1: TQCPolicy after (\d+) transitions", output)[1])
    assert transitions >= 4100
    assert 0 < float(re.search(r"tracking error ([\d.]+) m", output)[1]) < 3
    assert np.isfinite(last_logged(tmp_path, "train/critic_loss"))
    assert (tmp_path / "extend_algorithm.png").read_bytes().startswith(b"\x89PNG")


def test_a_resumed_run_of_that_algorithm_equals_an_uninterrupted_one(tmp_path, monkeypatch):
    def networks(network):
        return {
            "features_extractor_class": FlockCNN,
            "features_extractor_kwargs": extractor_kwargs(network),
            "net_arch": list(network.net_arch),
        }

    monkeypatch.setitem(ALGORITHMS, "tqc", AlgorithmSpec(TQC, TQCPolicy, networks, has_action_noise=False))
    whole = train(tiny(tmp_path / "whole", algo="tqc"), quiet())
    with pytest.raises(KeyboardInterrupt):
        train(tiny(tmp_path / "half", algo="tqc"), quiet(), callbacks=[Interruption()])
    (folder,) = (tmp_path / "half" / "runs").glob("*")
    resumed = resume(folder, quiet())
    first, second = training_state(whole), training_state(resumed)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(second[name], value, name)
    observation = np.random.default_rng(0).random((3, *whole.config.scenario.observation_shape), dtype=np.float32)
    loaded = load_policy(whole.folder / "final_model.zip")
    np.testing.assert_allclose(
        loaded.predict(observation)[0], whole.model.predict(observation, deterministic=True)[0], atol=1e-6
    )


def test_a_parameter_of_ones_own_is_validated_and_takes_effect(tmp_path):
    output = run("config", "weight_decay=0.01", "total_timesteps=60", "eval_freq=0", "buffer_size=100", cwd=tmp_path)
    assert "weight_decay: 0.01 # weight decay of both optimizers" in output
    assert output.count(": 0.01\n") == 2
    (folder,) = tmp_path.glob("runs/*")
    assert load_policy(folder).num_timesteps >= 60
    with pytest.raises(subprocess.CalledProcessError) as failure:
        run("config", "weight_decay=-1", cwd=tmp_path)
    assert "weight_decay = -1: input should be greater than or equal to 0" in failure.value.stderr


def test_dynamics_of_ones_own_train_evaluate_and_render(tmp_path):
    output = run("dynamics", 4100, cwd=tmp_path)
    assert "speed in the first step: 0.015 m/s" in output  # the mean of 0 and 0.03
    errors = {name: float(error) for name, error in re.findall(r"(\S+): tracking error ([\d.]+) m", output)}
    assert list(errors) == ["double-integrator", "unicycle"]
    assert "dynamics: double-integrator" in next(tmp_path.glob("runs/*/config.yaml")).read_text()
    assert (tmp_path / "extend_dynamics.png").read_bytes().startswith(b"\x89PNG")


def test_a_world_of_ones_own_trains_evaluates_and_renders(tmp_path):
    output = run("obstacles", 4100, cwd=tmp_path)
    free = {name.strip(): int(share) for name, share in re.findall(r"^ *([\w ]+): tracking.*free (\d+)%", output, re.M)}
    assert list(free) == ["flock", "trained with patrols"]
    assert free["flock"] >= 90
    assert "obstacle_motion: patrol" in next(tmp_path.glob("runs/*/config.yaml")).read_text()
    assert (tmp_path / "extend_obstacles.png").read_bytes().startswith(b"\x89PNG")


def test_a_simulator_of_ones_own_evaluates_and_renders(tmp_path):
    output = run("simulator", 20, cwd=tmp_path)
    errors = {name: float(error) for name, error in re.findall(r"(\S+): tracking error ([\d.]+) m", output)}
    assert list(errors) == ["robots", "unicycle"]
    assert errors["robots"] != errors["unicycle"]
    assert abs(errors["robots"] - errors["unicycle"]) < 0.01
    assert (tmp_path / "extend_simulator.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("extend_*.py")), ids=lambda path: path.stem)
def test_every_example_is_short_and_on_a_page_of_its_own(path):
    code = [line for line in path.read_text().splitlines() if line.strip()]
    assert len(code) <= 40
    pages = [page.read_text() for page in (ROOT / "docs" / "extending").glob("*.md")]
    assert sum(f"examples/{path.name}" in page for page in pages) == 1
    assert f'run("{path.stem.removeprefix("extend_")}"' in Path(__file__).read_text()
