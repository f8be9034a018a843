"""The live table of a sweep in a terminal, and its plain lines elsewhere."""

import io
import pickle
from dataclasses import dataclass, field

import pytest
from rich.console import Console

pytest.importorskip("ray")
from sb3_flock.sweep.table import TrialsTable

METRICS = {
    "tracking_error": 0.0871,
    "obstacle_violation_rate": 0.0001,
    "neighbor_violation_rate": 0.0034,
    "connectivity": 0.9923,
    "violation_free_rate": 1.0,
    "success_rate": 0.998,
}


@dataclass
class Trial:
    """What the table reads of Ray's trial."""

    name: str
    status: str = "RUNNING"
    last_result: dict = field(default_factory=dict)

    def __str__(self):
        return self.name


def table(**console):
    callback = TrialsTable()
    callback.console = Console(file=io.StringIO(), width=80, **console)
    return callback


def rows(callback, trials):
    """The table as text, once."""
    console = Console(file=io.StringIO(), width=80)
    console.print(callback._table(trials))
    return console.file.getvalue().splitlines()


def test_the_table_has_the_ended_trials_and_the_running_ones_within_80_columns():
    callback = table(force_terminal=True, height=12)
    waiting = Trial("waiting", "PENDING")
    running = Trial("00001-seed=1-" + "x" * 60, last_result={"timesteps": 500, "total_timesteps": 1000, **METRICS})
    done = Trial(
        "00000-seed=0", "TERMINATED", {"status": "done", "timesteps": 1000, "total_timesteps": 1000, "test": METRICS}
    )
    callback.on_trial_start(0, [waiting, running], running)
    callback.on_trial_complete(0, [running, done], done)
    callback.on_step_end(0, [running, done])
    lines = rows(callback, [waiting, running, done])
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert "waiting" not in text
    (first,) = [line for line in lines if line.strip().startswith("00000-seed=0")]
    assert first.split()[1:] == ["done", "100%", "0.087", "0.01%", "0.34%", "99.23%", "100.00%", "99.80%"]
    (second,) = [line for line in lines if line.strip().startswith("00001-seed=1")]
    assert second.split()[1:] == ["running", "50%", "0.087", "0.01%", "0.34%", "99.23%", "100.00%", "99.80%"]
    assert len(second.split()[0]) >= 12
    callback.on_experiment_end([running, done])
    shown = callback.console.file.getvalue()
    assert "1 running, 1 done" in shown
    assert callback._live is None


def test_a_table_too_long_for_the_terminal_keeps_the_running_trials():
    callback = table(force_terminal=True, height=10)
    ended = [Trial(f"ended{number}", "ERROR") for number in range(9)]
    running = [Trial(f"running{number}") for number in range(3)]
    for trial in ended:
        callback.on_trial_error(0, [*ended, *running], trial)
    text = "\n".join(rows(callback, [*ended, *running]))
    assert [f"running{number}" in text for number in range(3)] == [True] * 3
    assert [f"ended{number}" in text for number in range(9)] == [False] * 8 + [True]
    callback.on_experiment_end([*ended, *running])


def test_without_a_terminal_each_event_is_a_plain_line():
    callback = table(force_terminal=False)
    trial = Trial("00000", last_result={"status": "done", "test": METRICS})
    callback.on_trial_start(0, [trial], Trial("00001"))
    callback.on_trial_recover(0, [trial], Trial("00001"))
    callback.on_trial_complete(0, [trial], trial)
    callback.on_trial_error(0, [trial], Trial("00001", "ERROR"))
    callback.on_step_end(0, [trial])
    callback.on_experiment_end([trial])
    assert callback.console.file.getvalue().splitlines() == [
        "[1 of 1 done] 00001: starts",
        "[1 of 1 done] 00001: lost; resumes from its last checkpoint",
        "[1 of 1 done] 00000: done, tracking 0.087, obst. viol. 0.01%, neigh. viol. 0.34%, connected 99.23%, free 100.00%, "
        "success 99.80%",
        "[1 of 1 done] 00001: failed",
    ]


def test_ray_pickles_a_new_table():
    callback = table(force_terminal=True)
    callback._ended.append(Trial("old"))
    again = pickle.loads(pickle.dumps(callback))
    assert isinstance(again, TrialsTable)
    assert again._ended == []
