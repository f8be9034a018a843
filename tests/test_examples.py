"""Every example runs, with an argument that makes it short."""

import re
from pathlib import Path

import pytest
from PIL import Image

from sb3_flock.cli import main
from tests.helpers import run_example

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_the_sb3_script_is_short_trains_and_saves(tmp_path):
    assert "mean=" in run_example("train_with_sb3.py", 2100, cwd=tmp_path)
    assert (tmp_path / "flock_ddpg.zip").exists()
    assert (tmp_path / "train_with_sb3.png").exists()
    code = (EXAMPLES / "train_with_sb3.py").read_text().splitlines()
    assert len([line for line in code if line.strip() and not line.startswith('"""')]) < 25


def test_neighbors_of_another_env(tmp_path):
    assert "2004 transitions" in run_example("neighbors_of_another_env.py", 2000, cwd=tmp_path)
    assert (tmp_path / "neighbors_of_another_env.png").exists()


def test_evaluating_a_policy_in_other_flock_sizes(tmp_path):
    words = ["train", "--total-timesteps", "60", "--eval-freq", "0", "--output-dir", str(tmp_path)]
    assert main([*words, "--set", "n_test_episodes=1", "--set", "buffer_size=100"]) == 0
    assert run_example("evaluate_policy.py", tmp_path / "ddpg_3v1o_1", cwd=tmp_path).count("vehicles:") == 4
    assert (tmp_path / "evaluate_policy.png").exists()


def test_a_custom_extractor_trains(tmp_path):
    output = run_example("custom_extractor.py", 1200, cwd=tmp_path)
    assert "FlatMLP" in output
    assert "tracking error" in output
    assert (tmp_path / "custom_extractor.png").exists()


def test_a_policy_and_a_baseline_controller_on_the_same_episodes(tmp_path):
    output = run_example("beside_olfati_saber.py", "ddpg", 10, cwd=tmp_path)
    assert [line.split(":")[0].strip() for line in output.splitlines()] == ["ours", "Olfati-Saber"]
    assert (tmp_path / "beside_olfati_saber.png").read_bytes().startswith(b"\x89PNG")


def test_a_policy_and_orca_in_one_gif(tmp_path):
    pytest.importorskip("pyrvo")
    run_example("beside_orca.py", 6, cwd=tmp_path)
    with Image.open(tmp_path / "beside_orca.gif") as picture:
        assert (picture.size, picture.n_frames) == ((880, 470), 4)


def test_a_training_in_weights_and_biases_without_a_network(tmp_path, monkeypatch):
    for name, value in {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "WANDB_DIR": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    assert "best_model.zip is an artifact of the run " in run_example("track_with_wandb.py", 1000, cwd=tmp_path)
    (folder,) = (tmp_path / "wandb").glob("offline-run-*")
    stored = next(folder.glob("*.wandb")).read_bytes()
    for name in (b"eval/tracking_error", b"separation_penalty", b"best_model.zip"):
        assert name in stored


def test_parameter_sharing(tmp_path):
    output = run_example("parameter_sharing.py", cwd=tmp_path)
    assert "computed alone, the same: True" in output
    assert "[[1" in output


@pytest.mark.parametrize(
    ("policy", "settings"),
    [("ddpg", []), ("flock", []), ("flock", ["--set", "safety_filter=off"])],
)
def test_the_onboard_example_needs_numpy_and_onnxruntime_alone(tmp_path, policy, settings):
    assert main(["export", policy, "-o", str(tmp_path / "policy.onnx"), *settings]) == 0
    output = run_example("fly_onboard.py", tmp_path / "policy.onnx", cwd=tmp_path)
    last = [float(number) for number in re.findall(r"([\d.]+) m ", output.splitlines()[-1])]
    assert last[0] < 0.15
    assert last[1] >= 0.1
    assert last[2] >= 0.15
    imported = set(re.findall(r"^import (\w+)", (EXAMPLES / "fly_onboard.py").read_text(), re.MULTILINE))
    assert imported <= {"json", "sys", "numpy", "onnxruntime"}


def test_every_example_has_a_test():
    source = Path(__file__).read_text()
    for path in EXAMPLES.glob("*.py"):
        assert path.name in source or path.name.startswith("extend_")  # those are in test_extending.py
