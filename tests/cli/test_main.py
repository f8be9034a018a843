import os
import subprocess
import sys

import pytest

from sb3_flock.cli import COMMANDS, main
from sb3_flock.settings import SettingsError


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["fly"], ["invalid choice: 'fly'", "migrate"]),
        ([], ["COMMAND"]),
        (["migrate", "a\0b"], ["a null character"]),
        (["evaluate"], ["POLICY or --controller NAME"]),
        (["evaluate", "x.zip", "--controller", "orca"], ["not both"]),
        (["evaluate", "--controller", "boids"], ["controller = 'boids'", "olfati-saber"]),
        (["evaluate", "--controller", "random", "--obstacle-motion", "siege"], ["obstacle_motion = siege", "crossing"]),
        (["evaluate", "no/such.zip"], ["no/such.zip", "no such file or run folder"]),
        (["evaluate", __file__], ["damaged or not a policy file"]),
        (["evaluate", os.path.dirname(__file__)], ["no best_model.zip"]),
        (["render", "ddpg"], ["-o/--output"]),
        (["render", "ddpg", "-o", "x.avi"], ["--output x.avi: a name that ends in .gif, .mp4, .html, .png, .svg"]),
        (["render", "ddpg", "-o", "no/such/x.gif"], ["--output no/such/x.gif: there is no folder no/such"]),
        (["export", "ddpg"], ["-o FILE"]),
        (["export", "ddpg", "a.onnx", "-o", "b.onnx"], ["one -o FILE"]),
        (["export", "ddpg", "-o", "no/such/a.onnx"], ["--output no/such/a.onnx: there is no folder no/such"]),
        (["compare", "x", "-o", "curves.pdf"], ["--output curves.pdf: a name that ends in .png, .svg is needed"]),
        (["reproduce", "-o", "/dev/null/x"], ["--output /dev/null/x: "]),
        (["sweep"], ["a FILE or --resume DIR is needed"]),
        (["sweep", "x.yaml", "--resume", "y"], ["not both"]),
        (["sweep", "--resume", "y", "-o", "z"], ["--resume and --output"]),
        (["play", "no/such"], ["no such file or run folder"]),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(words, expected, fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fails(words, *expected)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_a_screen_and_gives_an_example(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert len(shown.splitlines()) <= 55
    assert shown.splitlines()[-1].startswith(f"example: sb3-flock {name} ")


def test_the_main_help_lists_every_command(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert [name for name in COMMANDS if f"\n    {name} " not in shown] == []
    assert "example: sb3-flock train" in shown


def test_the_command_is_installed():
    command = os.path.join(os.path.dirname(sys.executable), "sb3-flock")
    shown = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.startswith("sb3-flock 0.")


HEAVY = {"torch", "stable_baselines3", "numba", "scipy", "supersuit", "tensorboard", "matplotlib", "pandas"}
"""What only a command that runs may import."""

LIGHT = {"pydantic", "yaml", "rich", "sb3_flock.sim", "sb3_flock.serialization"}
"""What is not imported before a subcommand is chosen."""


def imported(code, modules):
    """Which of the modules a new process has imported after it ran the code."""
    code = f"""
import sys
try:
    {code}
except SystemExit:
    pass
sys.stderr.write(" ".join({modules} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stderr.split()


@pytest.mark.parametrize(
    "code",
    ["import sb3_flock", *(f"from sb3_flock.cli import main; main(['{word}'])" for word in ("--help", "--version"))],
)
def test_the_package_and_the_main_help_import_no_part_of_it(code):
    assert imported(code, HEAVY | LIGHT | {f"sb3_flock.cli.{name}" for name in COMMANDS}) == []


@pytest.mark.parametrize(
    "words", [*([name, "--help"] for name in COMMANDS), ["config"], ["policies"], ["policies", "flock"]]
)
def test_help_and_what_only_prints_need_nothing_heavy(words):
    assert imported(f"from sb3_flock.cli import main; main({words})", HEAVY) == []


def test_a_baseline_controller_is_evaluated_without_torch():
    words = ["evaluate", "--controller", "go-to-waypoint", "-n", "1", "--set", "max_cycles=2"]
    assert imported(f"from sb3_flock.cli import main; main({words})", HEAVY - {"numba", "scipy"}) == []


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError("32 GB\nare needed"), 1, "not enough memory: 32 GB are needed"),
        (SettingsError("gamma = 2"), 2, "gamma = 2"),
    ],
)
def test_exit_codes(error, code, line, capsys, monkeypatch):
    def stop(path):
        raise error

    monkeypatch.setattr("sb3_flock.serialization.rewrite.rewrite", stop)
    assert main(["migrate", "x"]) == code
    assert capsys.readouterr().err == f"sb3-flock: {line}\n"


@pytest.mark.parametrize("words", [["--version"], ["config"], ["policies"], ["policies", "flock"]])
def test_output_that_cannot_be_written_is_one_line(words):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "sb3_flock.cli", *words], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert (done.returncode, done.stderr) == (1, b"sb3-flock: output: No space left on device\n")


@pytest.mark.parametrize("words", [["--version"], ["config"], ["policies"]])
def test_output_that_nobody_reads_is_no_traceback(words):
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-m", "sb3_flock.cli", *words], stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("name", ["x[/y]", "runs[v2]", ":smile:"])
def test_a_folder_is_named_as_it_is(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [
        "--total-timesteps",
        "60",
        "-f",
        name,
        "--eval-freq",
        "0",
        "--set",
        "n_test_episodes=1",
        "--set",
        "buffer_size=100",
    ]
    assert main(["train", *words]) == 0
    captured = capsys.readouterr()
    assert captured.out.endswith(f"{name}/ddpg_3v1o_1\n")
    assert f"{name}/ddpg_3v1o_1" in captured.err
