"""A run folder that the command itself makes, and the check of a refusal."""

import pytest

from sb3_flock.cli import main

SETTINGS = ("learning_starts=60", "n_eval_episodes=2", "buffer_size=500", "max_cycles=20", "n_test_episodes=3")
TINY = [word for setting in SETTINGS for word in ("--set", setting)]
"""Flags for a training of seconds."""


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A run folder made by the command itself."""
    out = tmp_path_factory.mktemp("out")
    words = [
        "train",
        "--n-vehicles",
        "2",
        "--n-obstacles",
        "1",
        "--total-timesteps",
        "200",
        "--n-flocks",
        "2",
        "--seed",
        "3",
    ]
    assert main([*words, "--eval-freq", "100", "--output-dir", str(out), *TINY]) == 0
    return out / "ddpg_2v1o_1"


@pytest.fixture
def fails(capsys):
    """A function that checks that a command ends with exit code 2 and one line on stderr that holds the expected words."""

    def check(words, *expected):
        try:
            code = main(words)
        except SystemExit as stop:  # argparse's own
            code = stop.code
        captured = capsys.readouterr()
        assert code == 2
        assert captured.err.count("\n") == 1
        assert captured.err.startswith("sb3-flock")
        for word in expected:
            assert word in captured.err

    return check
