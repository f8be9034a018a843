import pytest

pytest.importorskip("ray")
from sb3_flock.cli import main
from sb3_flock.cli.parsing import FAILED, INTERRUPTED
from sb3_flock.sweep.run import Trial


def trial(status, why=""):
    return Trial(f"trial_{status}", {"seed": 0}, status, why, {}, {}, "")


@pytest.fixture
def sweep_of(monkeypatch, tmp_path):
    """A sweep whose trials end as given, without Ray; a function that runs it by the command."""
    file = tmp_path / "mine.yaml"
    file.write_text("grid: {seed: [0, 1]}\n")
    monkeypatch.setattr("sb3_flock.sweep.statistics.report", lambda config, trials, out: [])

    def run(trials, *words):
        calls = []
        monkeypatch.setattr("sb3_flock.sweep.run.sweep", lambda *arguments: calls.append(arguments) or trials)
        code = main(["sweep", str(file), "-o", str(tmp_path / "out"), *words])
        return code, calls

    return run


@pytest.mark.parametrize(
    ("statuses", "code"),
    [(("done", "diverged"), 0), (("done", "failed"), FAILED), (("failed", "unfinished"), INTERRUPTED)],
)
def test_the_exit_code_says_whether_all_trials_ended(statuses, code, sweep_of, tmp_path, capsys):
    ended, _ = sweep_of([trial(status, "a reason" if status != "done" else "") for status in statuses])
    assert ended == code
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'out'}\n"
    for status in statuses:
        assert (f"sb3-flock: trial_{status}: {status}: a reason\n" in captured.err) == (status != "done")
    open_trials = len({"failed", "unfinished"} & set(statuses))
    line = f"sb3-flock: {open_trials} trials did not end; to continue: sb3-flock sweep --resume {tmp_path / 'out'}\n"
    assert (line in captured.err) == (code != 0)


def test_flags_reach_the_sweep(sweep_of, tmp_path):
    code, ((config, output, address),) = sweep_of([trial("done")], "--set", "total_timesteps=1e3", "--address", "auto")
    assert (code, output, address) == (0, str(tmp_path / "out"), "auto")
    assert config.training({"seed": 1}).total_timesteps == 1000
    _, ((config, *_),) = sweep_of([trial("done")], "--evaluate", "flock", "-n", "7")
    assert (config.policy, config.episodes) == ("flock", 7)


def test_episodes_without_a_policy_are_refused(fails, tmp_path):
    (tmp_path / "mine.yaml").write_text("grid: {seed: [0, 1]}\n")
    fails(["sweep", str(tmp_path / "mine.yaml"), "--episodes", "3"], "--episodes 3: only with --evaluate")
