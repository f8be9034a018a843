"""Real faults: kills, signals, full disks, dead workers, diverged losses, damaged checkpoints. Each in a process of its own."""

import contextlib
import ctypes
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import resume, train
from sb3_flock.serialization.archive import read_curves
from sb3_flock.serialization.load import checkpoint_paths, load_policy
from sb3_flock.serialization.yaml_io import to_yaml
from sb3_flock.settings import SettingsError
from sb3_flock.training.checkpoint import LoadedCheckpoint
from tests.helpers import quiet, tiny, training_state

resource = pytest.importorskip("resource", reason="signals and limits of POSIX")

LONG = {"total_timesteps": 10_000_000, "save_freq": 60, "eval_freq": 600, "n_test_episodes": 2}

# The command line, but that its transitions are counted in a file.
DRIVER = """
import os, signal, sys
from stable_baselines3.common.callbacks import BaseCallback
import sb3_flock.training.train as training

class Position(BaseCallback):
    def _on_step(self):
        os.pwrite(file, b"%12d" % self.num_timesteps, 0)
        return True

file = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT)
run = training._run
training._run = lambda *args: run(*args[:-2], [Position()], args[-1])
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job inherits an ignored one
from sb3_flock.cli import main
sys.exit(main(sys.argv[2:]))
"""


class Run:
    """``sb3-flock train`` in a process of its own."""

    def __init__(self, position_file, *words, limit=None):
        self.position_file = position_file
        command = [sys.executable, "-c", DRIVER, str(self.position_file), "train", *map(str, words)]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            preexec_fn=limit,  # noqa: PLW1509 - no threads here
        )

    def position(self):
        """Transitions so far."""
        try:
            return int(self.position_file.read_text() or 0)
        except FileNotFoundError:
            return 0

    def wait_for(self, transitions, seconds=120):
        deadline = time.monotonic() + seconds
        while self.position() < transitions and self.process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def end(self, number=None, seconds=120):
        """Send a signal, wait, and give the exit code and what was printed."""
        if number is not None:
            self.process.send_signal(number)
        try:
            out, errors = self.process.communicate(timeout=seconds)
        finally:
            self.process.kill()
            self.process.wait()
        if self.process.returncode >= 0:
            assert "Traceback" not in errors, errors
        return self.process.returncode, out, errors


@pytest.fixture
def start(tmp_path):
    """Start a run; it is killed at the end of the test at the latest."""
    runs = []

    def begin(*words, **kwargs):
        runs.append(Run(tmp_path / f"position_{len(runs)}", *words, **kwargs))
        return runs[-1]

    yield begin
    for run in runs:
        run.process.kill()
        run.process.communicate()


def config_file(tmp_path, **changes):
    config = tiny(tmp_path, **{**LONG, **changes})
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(config))
    return config, path


def newest(folder):
    """The newest checkpoint, which is whole."""
    return LoadedCheckpoint(checkpoint_paths(folder)[-1], 10**9)


def assert_same_ends(folder, alone):
    """That a run ended as the training that was left alone, to the last bit."""
    ours, theirs = training_state(SimpleNamespace(folder=folder)), training_state(alone)
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)


def survive(kills, total, tmp_path, start):
    """Kill a run so often, at random moments; then let it end and compare it with one that was left alone."""
    config, path = config_file(tmp_path, total_timesteps=total, buffer_size=3000)
    folder = tmp_path / "runs" / "ddpg_3v1o_1"
    moments = random.Random(0)
    for kill in range(kills):
        run = start("--resume", folder) if folder.exists() else start("--config", path)
        run.wait_for(1 if kill else 200)
        if kill % 4 == 3:  # in the midst of writing a checkpoint, if it can be met
            deadline = time.monotonic() + 5
            while not list(folder.glob(".rl_model*.tmp")) and time.monotonic() < deadline:
                pass
        else:
            time.sleep(moments.uniform(0, 1.5))
        run.process.kill()
        run.process.wait()
        done = run.position()
        assert done < total
        whole = [LoadedCheckpoint(checkpoint, 10**9) for checkpoint in checkpoint_paths(folder)]
        assert len(whole) <= config.keep_checkpoints + 1  # killed between a new one and the removal of the oldest
        assert whole[-1].num_timesteps > done - config.save_freq - 2 * 6  # an interval, and the step under way
    code, _, errors = start("--resume", folder).end(seconds=250)
    assert code == 0, errors
    alone = train(config.replace(output_dir=str(tmp_path / "alone")), quiet())

    assert_same_ends(folder, alone)


def test_a_killed_run_resumes_and_ends_as_if_never_killed(tmp_path, start):
    survive(2, 3000, tmp_path, start)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_twenty_kills(tmp_path, start):
    survive(20, 20_000, tmp_path, start)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_saves_first_and_prints_how_to_resume(tmp_path, start, number, code):
    _, path = config_file(tmp_path, save_freq=0)
    run = start("--config", path)
    run.wait_for(200)
    returned, _, errors = run.end(number)
    assert returned == code
    folder = tmp_path / "runs" / "ddpg_3v1o_1"
    steps = newest(folder).num_timesteps
    assert steps == run.position()  # nothing is lost
    assert f"rl_model_{steps}_steps.zip is saved; to continue: sb3-flock train --resume {folder}" in errors
    assert load_policy(folder).path.name in {"best_model.zip", f"rl_model_{steps}_steps.zip"}
    if number == signal.SIGINT:
        code, _, errors = start("--resume", folder, "--total-timesteps", steps + 60).end()
        assert code == 0
        assert f"resumes {folder} after {steps} of {steps + 60} transitions; total_timesteps = {steps + 60} (" in errors


def test_a_full_disk_is_one_line_and_leaves_what_was_saved(tmp_path, start):
    _, path = config_file(tmp_path, **{"scenario.max_cycles": 200})
    limit = 400_000  # bytes that a file may have; the replay buffer grows into it
    run = start("--config", path, limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
    code, _, errors = run.end()
    assert code == 1
    last = errors.strip().splitlines()[-1]
    assert "File too large" in last
    folder = tmp_path / "runs" / "ddpg_3v1o_1"
    whole = newest(folder)
    assert f"{whole.path.name} is saved; to continue: sb3-flock train --resume {folder}" in last
    assert not list(folder.glob("*.tmp")) + list(folder.glob(".*.tmp"))
    code, _, _ = start("--resume", folder, "--total-timesteps", whole.num_timesteps + 60).end()
    assert code == 0


def test_a_run_folder_that_is_gone_is_one_line(tmp_path, start):
    _, path = config_file(tmp_path)
    run = start("--config", path)
    run.wait_for(200)
    shutil.rmtree(tmp_path / "runs")
    code, _, errors = run.end()
    assert code == 1
    assert "No such file or directory" in errors.strip().splitlines()[-1]


def obey_permissions():
    """Drop what lets root write into read-only folders, CAP_DAC_OVERRIDE; others neither have it nor may drop it."""
    ctypes.CDLL(None).prctl(24, 1)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux capabilities")
def test_a_folder_that_turns_read_only_is_one_line_and_leaves_what_was_saved(tmp_path, start):
    _, path = config_file(tmp_path)
    run = start("--config", path, limit=obey_permissions)
    folder = tmp_path / "runs" / "ddpg_3v1o_1"
    run.wait_for(200)
    folder.chmod(0o555)
    code, _, errors = run.end()
    assert code == 1
    whole = newest(folder)
    last = errors.strip().splitlines()[-1]
    assert "Permission denied" in last
    assert f"{whole.path.name} is saved; to continue: sb3-flock train --resume {folder}" in last
    code, _, errors = start("--resume", folder, limit=obey_permissions).end()
    assert code == 1
    assert "Permission denied" in errors.strip().splitlines()[-1]
    folder.chmod(0o755)
    code, _, _ = start("--resume", folder, "--total-timesteps", whole.num_timesteps + 60).end()
    assert code == 0


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("victim", ["worker", "parent"])
def test_no_process_outlives_a_killed_one(tmp_path, start, victim):
    _, path = config_file(tmp_path, num_cpus=2)
    run = start("--config", path)
    run.wait_for(200)
    workers = children(run.process.pid)
    assert len(workers) == 2
    os.kill(workers[0] if victim == "worker" else run.process.pid, signal.SIGKILL)
    code, _, errors = run.end(seconds=60)
    if victim == "worker":
        assert code == 1
        assert f"an environment worker died: process {workers[0]} (exit code -9)" in errors.strip().splitlines()[-1]
    deadline = time.monotonic() + 20
    while any(is_alive(worker) for worker in workers):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    folder = tmp_path / "runs" / "ddpg_3v1o_1"
    steps = newest(folder).num_timesteps
    if victim == "worker":
        code, _, errors = start("--resume", folder, "--total-timesteps", steps + 60).end()
        assert code == 0
        assert "not bit-exact: worker processes start new episodes" in errors


def children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_alive(pid):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    return False


def test_a_diverged_training_is_one_line_and_is_not_saved(tmp_path, start):
    _, path = config_file(tmp_path, learning_rate=1e6, save_freq=30, learning_starts=100)
    code, _, errors = start("--config", path).end()
    assert code == 1
    assert "the training diverged" in errors.strip().splitlines()[-1]
    saved = newest(tmp_path / "runs" / "ddpg_3v1o_1")
    assert all(bool(th.isfinite(tensor).all()) for tensor in saved.tensors["policy.pth"].values())


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty"])
def test_a_damaged_newest_checkpoint_is_skipped(tmp_path, damage):
    result = train(tiny(tmp_path, total_timesteps=600, save_freq=150), quiet())
    older, last = checkpoint_paths(result.folder)
    whole = last.read_bytes()
    middle = len(whole) // 2
    last.write_bytes(
        {
            "truncated": whole[:middle],
            "flipped": whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :],
            "empty": b"",
        }[damage]
    )
    steps = LoadedCheckpoint(older, 10**9).num_timesteps
    console = Console(file=io.StringIO(), width=200)
    resume(result.folder, console)
    printed = console.file.getvalue()
    assert f"skipped {last}: damaged or not a checkpoint" in printed
    assert f"resumes {result.folder} after {steps} of 600 transitions" in printed
    assert last.read_bytes() != whole[:middle]
    assert newest(result.folder).num_timesteps == 600


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """A training that has ended, with two checkpoints."""
    return train(tiny(tmp_path_factory.mktemp("ended"), total_timesteps=600, save_freq=150), quiet())


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda state: state["model"].update(num_timesteps=-1), "model.num_timesteps: "),
        (lambda state: state["model"].update(num_timesteps=True), "model.num_timesteps: "),
        (lambda state: state["model"]["replay"].update(pos=10**6), "model.replay: Value error, position 1000000 in"),
        (lambda state: state["model"]["env"][0]["world"].update(steps=21), "steps = 21: 0 to 20 are possible"),
        (lambda state: state["parts"]["evaluation"].update(last="x"), "parts.evaluation.last: "),
        (lambda state: state["parts"].pop("metrics"), "parts.metrics: "),
    ],
)
def test_a_newest_checkpoint_with_values_that_cannot_be_is_skipped(tmp_path, ended, damage, why):
    folder = shutil.copytree(ended.folder, tmp_path / "run")
    older, last = checkpoint_paths(folder)
    with zipfile.ZipFile(last) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    state = json.loads(members["training.json"])
    damage(state)
    members["training.json"] = json.dumps(state).encode()
    with zipfile.ZipFile(last, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    (folder / "final_model.zip").unlink()  # as of a run that did not end
    steps = LoadedCheckpoint(older, 10**9).num_timesteps
    console = Console(file=io.StringIO(), width=500)
    resume(folder, console)
    skipped, resumed = console.file.getvalue().splitlines()[:2]
    assert skipped.startswith(f"skipped {last}: ")
    assert why in skipped
    assert resumed.startswith(f"resumes {folder} after {steps} of 600 transitions")
    assert newest(folder).num_timesteps == 600


def pause(seconds, tmp_path, start):
    """Stop a run as a laptop that sleeps does, let it go on, and compare it with one that was left alone."""
    config, path = config_file(tmp_path, total_timesteps=1500, save_freq=600)
    run = start("--config", path)
    run.wait_for(300)
    run.process.send_signal(signal.SIGSTOP)
    time.sleep(0.5)
    before = run.position()
    time.sleep(seconds)
    assert run.position() == before < 1500
    code, _, errors = run.end(signal.SIGCONT)
    assert code == 0, errors
    alone = train(config.replace(output_dir=str(tmp_path / "alone")), quiet())
    assert_same_ends(tmp_path / "runs" / "ddpg_3v1o_1", alone)


def test_a_run_that_is_stopped_goes_on(tmp_path, start):
    pause(1, tmp_path, start)


@pytest.mark.slow
def test_a_run_that_is_stopped_for_a_minute_goes_on(tmp_path, start):
    pause(60, tmp_path, start)


@pytest.mark.parametrize("jump", [-86_400, 30 * 86_400])
def test_a_clock_that_jumps_changes_nothing(tmp_path, monkeypatch, jump):
    alone = train(tiny(tmp_path / "alone"), quiet())
    seconds, nanoseconds, ahead = time.time, time.time_ns, [0]
    monkeypatch.setattr(time, "time", lambda: seconds() + ahead[0])
    monkeypatch.setattr(time, "time_ns", lambda: nanoseconds() + 10**9 * ahead[0])

    class Jump(BaseCallback):
        def _on_step(self):
            ahead[0] = jump if self.num_timesteps > 100 else 0
            return True

    jumped = train(tiny(tmp_path / "jumped"), quiet(), callbacks=[Jump()])
    assert ahead == [jump]
    assert_same_ends(jumped.folder, alone)
    assert (read_curves(jumped.folder / "evaluations.npz")["seconds"] >= 0).all()


def test_a_clock_before_1980_is_one_line_and_nothing_is_left(tmp_path, monkeypatch):
    config = tiny(tmp_path)
    monkeypatch.setattr(time, "localtime", lambda *_: time.gmtime(86_400))
    with pytest.raises(SettingsError, match="clock says 1970-01-02: zip files need a date from 1980 on"):
        train(config, quiet())
    assert not (tmp_path / "runs").exists()


def test_a_folder_whose_name_is_not_utf_8_is_one_line(tmp_path):
    folder = os.fsdecode(bytes(tmp_path) + b"/caf\xe9")
    with pytest.raises(SettingsError, match=r"/caf\?: TensorBoard needs a name in UTF-8$"):
        train(tiny(tmp_path, output_dir=folder), quiet())
    assert not os.path.exists(folder)


def test_two_trainings_never_share_a_run_folder(tmp_path, start):
    _, path = config_file(tmp_path)
    runs = [start("--config", path) for _ in range(2)]
    for run in runs:
        run.wait_for(60)
    folders = sorted((tmp_path / "runs").iterdir())
    assert [folder.name for folder in folders] == ["ddpg_3v1o_1", "ddpg_3v1o_2"]
    code, _, errors = start("--resume", folders[0]).end()
    assert code == 2
    assert errors == f"sb3-flock: {folders[0]}: another process trains in this folder\n"
    for run in runs:
        run.end(signal.SIGTERM)
