import sys

import numpy as np
import pytest

from sb3_flock.sim import Scenario, World, backend, episode_rng, observe
from sb3_flock.sim.backend import compiled


@pytest.fixture
def _fresh():
    """``compiled`` caches its result: each of these tests starts and ends without one."""
    compiled.cache_clear()
    yield
    compiled.cache_clear()


def sensed():
    world = World(Scenario(n_vehicles=6, n_obstacles=3, arena=0.3))
    return world.reset([episode_rng(0, 0)])


@pytest.mark.usefixtures("_fresh")
def test_with_numba_the_kernels_are_used():
    kernels = pytest.importorskip("sb3_flock.sim.kernels")
    assert compiled() is kernels


@pytest.mark.usefixtures("_fresh")
def test_without_numba_the_results_are_the_same(monkeypatch):
    with_numba = sensed()
    compiled.cache_clear()
    monkeypatch.delitem(sys.modules, "sb3_flock.sim.kernels", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    assert compiled() is None
    without = sensed()
    np.testing.assert_array_equal(with_numba.neighbors.positions, without.neighbors.positions)
    np.testing.assert_array_equal(with_numba.obstacles.bodies, without.obstacles.bodies)
    assert observe(without, Scenario()).max() > 0


@pytest.mark.usefixtures("_fresh")
def test_a_machine_without_a_folder_for_numbas_cache_uses_numpy(monkeypatch):
    def no_folder(name):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(backend.importlib, "import_module", no_folder)
    assert compiled() is None
