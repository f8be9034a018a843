import io

import pytest
from rich.console import Console

from sb3_flock import FlockDDPG, FlockPolicy, make_vec_env, train
from sb3_flock.sim import Scenario
from sb3_flock.training.progress_callback import FlockProgressCallback
from tests.helpers import quiet, tiny


def test_progress_is_plain_lines_in_a_pipe_and_a_panel_in_a_terminal(tmp_path):
    pipe = quiet()
    train(tiny(tmp_path), pipe)
    plain = pipe.file.getvalue()
    assert "\x1b" not in plain
    assert plain.count("evaluation at") == 3
    assert "torch threads 1" in plain
    terminal = Console(file=io.StringIO(), width=80, force_terminal=True)
    train(tiny(tmp_path), terminal)
    shown = terminal.file.getvalue()
    for words in (
        "env steps/s",
        "updates/s",
        "tracking error",
        "neighbor violations",
        "obstacle violations",
        "return",
        "evaluation at 120",
    ):
        assert words in shown


def script(callback, steps=60):
    """A plain script of SB3."""
    policy_kwargs = {"features_extractor_kwargs": {"features_dim": 8, "channels": (4,)}, "net_arch": [8]}
    env = make_vec_env(Scenario(max_cycles=10), n_flocks=2, seed=0)
    kwargs = {"policy_kwargs": policy_kwargs, "buffer_size": 100, "learning_starts": 30, "batch_size": 8, "device": "cpu"}
    return FlockDDPG(FlockPolicy, env, **kwargs).learn(steps, callback=callback)


def test_the_panel_of_a_plain_script_is_removed_at_the_end():
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    callback = FlockProgressCallback(console, 60)
    script(callback)
    shown = console.file.getvalue()
    assert "training" in shown
    assert "env steps/s" in shown
    assert "\x1b[?25l" in shown  # the cursor is hidden ...
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")  # ... and shown again
    callback.stop()
    assert console.file.getvalue() == shown


@pytest.mark.parametrize("is_terminal", [False, True])
def test_an_evaluation_is_a_line_of_its_own_without_a_terminal_alone(is_terminal):
    console = Console(file=io.StringIO(), width=100, force_terminal=is_terminal)

    class Reporting(FlockProgressCallback):
        def _on_rollout_end(self):
            if self.num_timesteps == 30:
                self.report_evaluation("evaluation at 30: it is good")

    script(Reporting(console, 60))
    lines = [line for line in console.file.getvalue().splitlines() if line.startswith("evaluation at 30: it is good | ")]
    assert len(lines) == (not is_terminal)
    if lines:
        assert lines[0].endswith(" updates/s")
    else:
        assert "evaluation at 30: it is good" in console.file.getvalue()


def test_speeds_are_those_of_the_last_marks():
    callback = FlockProgressCallback(quiet(), 100)
    assert callback.speeds() == (0.0, 0.0)
    callback._marks.extend([(10.0, 0, 0), (12.0, 600, 40)])
    assert callback.speeds() == (300.0, 20.0)
