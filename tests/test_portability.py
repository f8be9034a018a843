"""What Windows and macOS lack or do otherwise, as far as it can be imitated here."""

import os
import subprocess
import sys

import pytest

from sb3_flock.training.train import resume, train
from tests.helpers import quiet, tiny

# The dependencies, which have code for each system, are imported before.
WITHOUT_POSIX = """
import os, signal, sys
import filelock, gymnasium, numpy, pettingzoo, rich, stable_baselines3, supersuit, torch, torch.utils.tensorboard
for name in ("SIGHUP", "SIGKILL", "SIGSTOP", "SIGCONT", "SIGUSR1"):
    delattr(signal, name)
for name in ("sched_getaffinity", "fork", "geteuid"):
    delattr(os, name)
for name in ("resource", "fcntl", "pwd", "grp", "termios"):
    sys.modules[name] = None
from sb3_flock.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this is such a system")
def test_training_and_evaluation_need_nothing_that_only_posix_has(tmp_path):
    words = [
        *(
            "train",
            "-f",
            tmp_path,
            "--total-timesteps",
            "200",
            "--n-flocks",
            "2",
            "--eval-freq",
            "100",
            "--save-freq",
            "100",
        ),
        *(
            "--set",
            "learning_starts=40",
            "--set",
            "n_eval_episodes=2",
            "--set",
            "n_test_episodes=2",
            "--set",
            "max_cycles=20",
        ),
    ]
    command = [sys.executable, "-c", WITHOUT_POSIX, *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "ddpg_3v1o_1" / "final_model.zip").is_file()


def open_files():
    """Where the files lead that this process has open."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            found.add(os.readlink(f"/proc/self/fd/{number}"))
        except FileNotFoundError:  # of the listing itself
            continue
    return found


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="open files are listed in /proc")
def test_no_file_is_replaced_renamed_or_removed_while_it_is_open(tmp_path, monkeypatch):
    """Windows refuses that."""
    seen = []

    def closed_only(name):
        act = getattr(os, name)

        def checked(path, *others, **options):
            paths = [os.path.realpath(os.fspath(one)) for one in (path, *others) if not isinstance(one, int)]
            if any(one.startswith(str(tmp_path)) for one in paths):
                seen.append(name)
                opened = open_files()
                busy = [one for one in paths if any(file == one or file.startswith(one + os.sep) for file in opened)]
                if busy:
                    raise PermissionError(13, "another process has the file open", busy[0])
            return act(path, *others, **options)

        monkeypatch.setattr(os, name, checked)

    for name in ("replace", "rename", "unlink", "remove"):
        closed_only(name)
    result = train(tiny(tmp_path), quiet())
    resume(result.folder, quiet(), {"total_timesteps": 420})
    assert {"replace", "rename", "unlink"} <= set(seen)
