"""Shared fixtures. Every test runs on one torch thread: on shared cores more are slower."""

import multiprocessing
import os

import pytest
import torch as th

from sb3_flock import Scenario, make_vec_env, save_model
from sb3_flock.rl.registry import build_model
from tests.helpers import SMALL_MODEL

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


@pytest.fixture
def restored():
    """Call it with registries of the package: what a test registers there is removed afterwards."""
    saved = []

    def keep(*registries):
        saved.extend((registry, dict(registry)) for registry in registries)

    yield keep
    for registry, entries in reversed(saved):
        registry.clear()
        registry.update(entries)


@pytest.fixture
def scenario():
    return Scenario()


@pytest.fixture(scope="module")
def model():
    """A small untrained model."""
    return build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, 1, seed=0))


@pytest.fixture
def saved(model, tmp_path):
    """Its zip."""
    return save_model(model, tmp_path / "policy.zip", SMALL_MODEL)
