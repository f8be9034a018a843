"""The time from a cold shell: whole new processes, beside one that only imports torch."""

import os
import subprocess
import sys
import time

import numpy as np

from tests.benchmarks.conftest import POLICY

CLI = ("-m", "sb3_flock.cli")
TORCH, FIRST = "import torch", "evaluate 50 episodes, the first time"


def test_startup(benchmark, tmp_path_factory):
    """Rounds of all commands in turn, so that other load of the machine affects all of them."""
    evaluate = (*CLI, "evaluate", POLICY, "--episodes", "1" if benchmark.disabled else "50")
    commands = {
        TORCH: ("-c", "import torch"),
        "import sb3_flock": ("-c", "import sb3_flock"),
        "sb3-flock --help": (*CLI, "--help"),
        "sb3-flock train --help": (*CLI, "train", "--help"),
        "evaluate 50 episodes": evaluate,
        FIRST: evaluate,
    }
    if benchmark.disabled:
        del commands[FIRST]  # compiles again what the line before has in numba's cache
    seconds = {name: [] for name in commands}

    def one_round():
        for name, words in commands.items():
            env = {**os.environ, "OMP_NUM_THREADS": "1"}
            if name == FIRST:
                env["NUMBA_CACHE_DIR"] = str(tmp_path_factory.mktemp("empty"))
            start = time.perf_counter()
            subprocess.run([sys.executable, *words], env=env, capture_output=True, check=True)
            seconds[name].append(time.perf_counter() - start)

    benchmark.pedantic(one_round, rounds=10, warmup_rounds=1)
    if benchmark.disabled:
        return
    times = {name: np.array(spent[1:]) for name, spent in seconds.items()}
    for name, spent in times.items():
        benchmark.extra_info[name] = {
            "seconds": dict(zip(("min", "median", "max"), np.percentile(spent, [0, 50, 100]).tolist(), strict=True)),
            "times_torch": float(np.median(spent / times[TORCH])),
        }
