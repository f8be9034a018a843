import os
import subprocess
import sys
from importlib.metadata import version

import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import SettingsError
from sb3_flock.training.run_dir import create_run_dir, describe_run, lock_run_dir
from tests.helpers import tiny


def test_folders_are_numbered_by_algorithm_and_task(tmp_path):
    root = tmp_path / "runs"
    for changes, expected in (
        ({}, "ddpg_3v1o_1"),
        ({}, "ddpg_3v1o_2"),
        ({"algo": "td3", "n_vehicles": 5, "n_obstacles": 2}, "td3_5v2o_1"),
        ({}, "ddpg_3v1o_3"),
    ):
        assert create_run_dir(tiny(tmp_path, **changes), ["x"]) == root / expected
    (root / "ddpg_3v1o_1" / "x").touch()
    (root / "ddpg_3v1o_17").mkdir()
    (root / "ddpg_3v1o_copy").mkdir()
    assert create_run_dir(tiny(tmp_path), ["x"]) == root / "ddpg_3v1o_18"
    assert not [path for path in root.iterdir() if path.name.startswith(".")]


def test_a_folder_is_described_whole(tmp_path):
    config = tiny(tmp_path, seed=5)
    folder = create_run_dir(config, ["sb3-flock", "train", "--set", "output_dir=a b"])
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "command.txt", "versions.txt"}
    assert load_config(TrainingConfig, folder / "config.yaml") == config
    assert (folder / "command.txt").read_text() == "sb3-flock train --set 'output_dir=a b'\n"
    lines = (folder / "versions.txt").read_text().splitlines()
    assert f"torch=={version('torch')}" in lines
    assert lines[0].startswith("python==3.")


def test_a_description_again_adds_a_command_and_replaces_the_config(tmp_path):
    folder = create_run_dir(tiny(tmp_path), ["first"])
    longer = tiny(tmp_path, total_timesteps=900)
    describe_run(folder, longer, ["second", "--resume"])
    assert (folder / "command.txt").read_text() == "first\nsecond --resume\n"
    assert load_config(TrainingConfig, folder / "config.yaml") == longer


def test_without_a_command_this_processs_own_is_written(tmp_path):
    folder = create_run_dir(tiny(tmp_path), None)
    assert sys.argv[0].split("/")[-1] in (folder / "command.txt").read_text()


@pytest.mark.parametrize("where", ["file", "file/below"])
def test_an_output_dir_that_cannot_be_made_is_one_line(tmp_path, where):
    (tmp_path / "file").touch()
    config = tiny(tmp_path).replace(output_dir=str(tmp_path / where))
    with pytest.raises(SettingsError) as error:
        create_run_dir(config, ["x"])
    assert str(error.value) in {f"output_dir = {tmp_path / where}: {why}" for why in ("Not a directory", "File exists")}


HOLD = """
import sys
from pathlib import Path
from sb3_flock.training.run_dir import lock_run_dir
with lock_run_dir(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_locked_folder_is_refused_until_its_process_ends_even_by_a_kill(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    try:
        assert holder.stdout.readline() == "locked\n"
        with (
            pytest.raises(SettingsError, match=f"{tmp_path}: another process trains in this folder"),
            lock_run_dir(tmp_path),
        ):
            pass
    finally:
        holder.kill()
        holder.communicate()
    with lock_run_dir(tmp_path):
        assert (tmp_path / ".lock").exists()
    with lock_run_dir(tmp_path):  # and once more, after it was released
        pass


def test_a_folder_that_is_not_there_cannot_be_locked(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SettingsError, match="file: "), lock_run_dir(tmp_path / "file"):
        pass
