"""Whole sweeps by the command line: on one machine, on a cluster of two nodes, with kills."""

import csv
import io
import os
import random
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import torch as th

from sb3_flock import load_policy, train
from sb3_flock.sweep.config import load_sweep
from sb3_flock.sweep.run import Folder, _as_csv, _ended
from tests.helpers import TINY, quiet

pytest.importorskip("ray")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="kills as POSIX does")

SMALL = {**TINY, "n_test_episodes": 3}
LONG = {**SMALL, "total_timesteps": 4_000, "save_freq": 500, "eval_freq": 2_000, "buffer_size": 2_000}


@pytest.fixture(autouse=True)
def _not_nice(monkeypatch):
    """Ray's workers are nice by default, and would hardly get a core beside other tests."""
    monkeypatch.setenv("RAY_worker_niceness", "0")


class Sweep:
    """``sb3-flock sweep`` in a process of its own."""

    def __init__(self, *words):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sb3_flock.cli", "sweep", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
        )

    def wait_for_checkpoints(self, out, number):
        deadline = time.monotonic() + 120
        while len({path.parts[-3] for path in out.glob("*/checkpoint_*/rl_model_*_steps.zip")}) < number:
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def end(self):
        output, errors = self.process.communicate(timeout=250)
        return self.process.returncode, output, errors


def sweep_file(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


def results(out):
    with open(out / "results.csv", newline="") as file:
        return list(csv.DictReader(file))


def assert_the_same_as_trained_alone(file, out, tmp_path):
    """Every trial's last policy is that of ``train``, to the last bit."""
    config = load_sweep(file)
    rows = {int(row["seed"]): row for row in results(out)}
    for point in config.points():
        row = rows[point["seed"]]
        alone = train(config.training(point).replace(output_dir=str(tmp_path / "alone")), quiet())
        swept = load_policy(out / row["run"] / "final_model.zip").policy.state_dict()
        for name, tensor in alone.model.policy.state_dict().items():
            assert th.equal(tensor, swept[name]), (point, name)


def test_a_grid_writes_run_folders_a_table_and_a_ranking_and_survives_diverging_trials(tmp_path):
    """The storage is one that Ray reaches through fsspec alone."""
    file = sweep_file(tmp_path, f"base: {SMALL}\ngrid: {{learning_rate: [0.0005, 1000000.0], seed: [0, 1]}}\n")
    out = tmp_path / "out"
    code, output, errors = Sweep(file, "--output", f"local://{out}", "--set", "total_timesteps=420").end()
    assert code == 0, errors
    rows = results(out)
    assert {(row["algorithm.learning_rate"], row["seed"], row["status"]) for row in rows} == {
        *(("0.0005", seed, "done") for seed in "01"),
        *(("1000000.0", seed, "diverged") for seed in "01"),
    }
    assert all("the training diverged" in row["why"] for row in rows if row["status"] == "diverged")
    assert "learning_rate 0.0005" in output
    assert output.splitlines()[-1] == f"local://{out}"
    for row in rows:
        if row["status"] == "done":
            assert load_policy(out / row["run"]).config.total_timesteps == 420
            assert float(row["tracking_error"]) > 0
    for name in ("sweep.yaml", "ranking.csv", "ranking.png", "ranking.svg"):
        assert (out / name).stat().st_size > 0

    code, _, errors = Sweep(file, "--output", f"local://{out}").end()
    assert code == 2
    assert f"--output local://{out}: it exists already; resume its sweep, or choose another folder" in errors


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("kills", "trials"), [(1, 2), (20, 8)])
def test_a_sweep_with_a_killed_driver_resumes_to_the_same_policies(tmp_path, kills, trials):
    file, out = sweep_file(tmp_path, f"base: {LONG}\ngrid: {{seed: {list(range(trials))}}}\n"), tmp_path / "out"
    moments = random.Random(0)
    for kill in range(kills):
        sweep = Sweep("--resume", out) if kill else Sweep(file, "--output", out)
        sweep.wait_for_checkpoints(out, min(trials, 2))
        time.sleep(moments.uniform(0, 10) if kill else 0.5)
        assert sweep.process.poll() is None, "the sweep ended before it could be killed"
        sweep.process.send_signal(signal.SIGKILL)
        sweep.end()
    assert not (out / "results.csv").exists()
    code, _, errors = Sweep("--resume", out).end()
    assert code == 0, errors
    assert [row["status"] for row in results(out)] == ["done"] * trials
    assert_the_same_as_trained_alone(file, out, tmp_path)
    rows = results(out)
    code, _, errors = Sweep("--resume", out).end()  # nothing is left to do
    assert code == 0, errors
    assert results(out) == rows


@pytest.mark.slow
def test_the_trial_of_a_killed_node_resumes_on_the_other_node(tmp_path):
    from ray.cluster_utils import Cluster

    file, out = sweep_file(tmp_path, f"base: {LONG}\ngrid: {{seed: [0, 1]}}\n"), tmp_path / "out"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        node = cluster.add_node(num_cpus=1)
        run = Sweep(file, "--output", out, "--address", cluster.address)
        run.wait_for_checkpoints(out, 2)
        raylet = str(node.all_processes["raylet"][0].process.pid)
        workers = subprocess.run(["pgrep", "-P", raylet], capture_output=True, text=True, check=True).stdout.split()
        for pid in (raylet, *workers):  # a worker would run for a while without its raylet
            os.kill(int(pid), signal.SIGKILL)
        code, _, errors = run.end()
    finally:
        cluster.shutdown()
    assert code == 0, errors
    assert errors.count("lost; resumes from its last checkpoint") == 1
    commands = [(out / row["run"] / "command.txt").read_text() for row in results(out)]
    assert sorted(command.count("--resume") for command in commands) == [0, 1]
    assert_the_same_as_trained_alone(file, out, tmp_path)


@pytest.mark.slow
def test_an_interrupted_sweep_says_how_to_resume(tmp_path):
    file, out = sweep_file(tmp_path, f"base: {LONG}\ngrid: {{seed: [0, 1, 2]}}\n"), tmp_path / "out"
    run = Sweep(file, "--output", out)
    run.wait_for_checkpoints(out, 1)
    run.process.send_signal(signal.SIGINT)
    code, _, errors = run.end()
    assert code == 130
    assert "trials did not end" in errors.splitlines()[-1]
    assert errors.splitlines()[-1].endswith(f"sb3-flock sweep --resume {out}")
    assert {row["status"] for row in results(out)} <= {"unfinished", "done"}


def test_a_search_prints_its_best_trials(tmp_path):
    space = "{learning_rate: {low: 0.0001, high: 0.01, log: true}, batch_size: {low: 8, high: 32}, gamma: [0.9, 0.96]}"
    file, out = sweep_file(tmp_path, f"base: {SMALL}\nsearch: {space}\ntrials: 2\n"), tmp_path / "out"
    code, output, errors = Sweep(file, "--output", out).end()
    assert code == 0, errors
    rows = results(out)
    assert len(rows) == 2
    assert all(8 <= int(row["algorithm.batch_size"]) <= 32 for row in rows)
    assert len({row["algorithm.learning_rate"] for row in rows}) == 2
    assert "learning_rate" in output


def test_a_policy_over_a_grid_has_the_metrics_of_evaluate(tmp_path):
    from sb3_flock import evaluate

    file, out = sweep_file(tmp_path, "grid: {n_vehicles: [1, 4], seed: [3]}\n"), tmp_path / "out"
    code, _, errors = Sweep(file, "--evaluate", "ddpg", "--episodes", "5", "--output", out).end()
    assert code == 0, errors
    policy = load_policy("ddpg")
    for row in results(out):
        expected = evaluate(policy, policy.scenario.replace(n_vehicles=int(row["scenario.n_vehicles"])), 5, 3)
        assert float(row["tracking_error"]) == pytest.approx(expected["tracking_error"].mean, rel=1e-12)
        assert row["timesteps"] == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--set", "n_vehicles=-1"], "n_vehicles = -1: input should be greater than or equal to 1"),
        (["--address", "127.0.0.1:9"], "--address 127.0.0.1:9: no Ray cluster answers there"),
        (["--address", "nowhere"], "--address nowhere: no Ray cluster answers there"),
        (["--output", "strange://x"], "--output strange://x: Protocol not known: strange"),
        (["--evaluate", "nobody"], "nobody: no such file or run folder"),
        (
            ["--evaluate", "flock", "--set", "n_anchors=7"],
            "flock.zip: its observations have the shape (6, 11, 11), the scenario's (n_anchors = 7, motion_lag = 0.2) have "
            "(6, 7, 7)",
        ),
        (["--evaluate", "flock", "--set", "gamma=0.5"], "algorithm.gamma does not affect an evaluation"),
        (["--episodes", "3"], "--episodes 3: only with --evaluate"),
        (["--resume", "x"], "a FILE or --resume DIR is needed, and not both"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_file(words, message, tmp_path, monkeypatch, capsys):
    from sb3_flock.cli import main

    monkeypatch.chdir(tmp_path)
    assert main(["sweep", str(sweep_file(tmp_path, "grid: {seed: [0, 1]}\n")), *words]) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_a_trial_of_the_previous_release_has_todays_names(tmp_path):
    """Ray's state keeps each trial's point under the names of its release; the grid of the sweep has today's."""
    config = load_sweep("", text="grid: {train_env.flock_sizes: [[3]], algorithm.action_noise_std: [0.2]}")
    report = {"status": "done", "timesteps": 300, "test": {"tracking_error": 0.1}}
    kept = SimpleNamespace(
        config={"practice.vehicles": [3], "learner.noise": 0.2}, last_result=report, status="TERMINATED", checkpoint=None
    )
    trial = _ended(kept, Folder(str(tmp_path)))
    assert set(trial.point) == set(config.grid)
    (row,) = csv.DictReader(io.StringIO(_as_csv(config, [trial])))
    assert (row["train_env.flock_sizes"], row["algorithm.action_noise_std"], row["tracking_error"]) == ("[3]", "0.2", "0.1")


def test_more_resources_than_the_machine_has_are_refused(tmp_path):
    file = sweep_file(tmp_path, "grid: {seed: [0, 1]}\nresources: {cpus: 1024}\n")
    code, _, errors = Sweep(file, "--output", tmp_path / "out").end()
    assert code == 2
    assert "resources.cpus = 1024: this machine has" in errors.splitlines()[-1]
    assert not (tmp_path / "out").exists()
