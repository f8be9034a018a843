"""Shared fixtures. Every test runs on one torch thread: on shared cores more are slower."""

import multiprocessing
import os

import pytest
import torch as th

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(autouse=True)
def _one_torch_thread():
    th.set_num_threads(1)


@pytest.fixture(autouse=True)
def _no_worker_outlives_its_test():
    """A failed test may leave SuperSuit's workers open; the interpreter would wait for them at its end."""
    yield
    for worker in multiprocessing.active_children():
        worker.kill()
