import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import safety

kernels = pytest.importorskip("sb3_flock.sim.safety_kernels")


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 20), st.integers(0, 100))
def test_the_limited_speeds_are_those_of_numpy(seed, n_vehicles, n_contacts):
    rng = np.random.default_rng(seed)
    observers = np.sort(rng.integers(0, n_vehicles, n_contacts))
    strides, budgets = rng.uniform(-0.1, 0.1, n_contacts), rng.uniform(-0.005, 0.02, n_contacts)
    strides[rng.random(n_contacts) < 0.1] = 0.0
    speeds = rng.uniform(0, 0.15, n_vehicles)
    given_values = (speeds, speeds / 10, observers, strides, np.maximum(budgets, 0.0), 1e-4)
    plain = safety.limit_speeds(*given_values, use_numba=False)
    np.testing.assert_array_equal(kernels.limit_speeds(*given_values), plain)
    assert (plain <= speeds).all()
