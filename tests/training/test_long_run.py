"""A training of 24 million vehicle-steps in one process leaves nothing behind (``pytest -m slow``)."""

import gc
import os
import sys
import threading
from pathlib import Path

import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import train
from tests.helpers import quiet, tiny

STATM = Path("/proc/self/statm")


class Footprint(BaseCallback):
    """Resident memory [MB], open files and threads, in equal distances; the first ones are before the buffer is full."""

    def __init__(self, total, samples):
        super().__init__()
        self.every, self.samples = total // samples, []

    def _on_step(self):
        if self.num_timesteps >= self.every * (len(self.samples) + 1):
            gc.collect()
            megabytes = int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
            self.samples.append((megabytes, len(os.listdir("/proc/self/fd")), threading.active_count()))
        return True


def footprints(tmp_path, total, **changes):
    """A training with env, buffer, updates, evaluations and checkpoints; its footprints in 24 parts."""
    settings = {
        "total_timesteps": total, "n_flocks": 400, "max_cycles": 200, "n_obstacles": 2, "learning_starts": 2000,
        "buffer_size": 100_000, "batch_size": 64, "utd_ratio": 1 / 300, "eval_freq": total // 24, "n_eval_episodes": 50,
        "n_test_episodes": 1, "save_freq": total // 12,
    }  # fmt: skip
    config = tiny(tmp_path, **{**settings, **changes})
    footprint = Footprint(total, 24)
    train(config, quiet(), callbacks=[footprint])
    assert len(footprint.samples) == 24
    return footprint.samples


def check(samples, share):
    """Compare the last quarter with the second one."""
    memory, files, threads = zip(*samples, strict=True)
    print("memory [MB]", *(f"{megabytes:.0f}" for megabytes in memory), "files", set(files), "threads", set(threads))
    assert max(memory[18:]) <= (1 + share) * max(memory[6:12])
    assert len(set(files[6:])) == 1
    assert len(set(threads[6:])) == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_short_run_leaves_no_file_and_no_thread(tmp_path):
    smaller = {"n_flocks": 20, "max_cycles": 40, "buffer_size": 2000, "n_eval_episodes": 5}
    check(footprints(tmp_path, 12_000, **smaller), share=0.3)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_24_million_vehicle_steps_with_flat_memory(tmp_path):
    check(footprints(tmp_path, 24_000_000), share=0.02)
