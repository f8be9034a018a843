"""The compiled observation against its twin in NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import observation

numba = pytest.importorskip("numba")
kernels = pytest.importorskip("sb3_flock.sim.observation_kernels")


store_gaussians, store_sum_of_products = kernels._store_gaussians, kernels._store_sum_of_products


@numba.njit
def gaussians(out, x, step, row):
    store_gaussians(out, 1, x, step, np.exp(-step * step), row)


@numba.njit
def sum_of_products(out, at, factors, first, last, row):
    store_sum_of_products(out, at, factors, first, last, row)


@pytest.mark.parametrize("side", [2, 11, 16, 17])
@pytest.mark.parametrize("step", [0.5, 1.0])
def test_gaussians_of_sixteen_bodies_in_padded_rows(side, step):
    x = np.random.default_rng(side).uniform(-10, side + 10, 18)
    out = np.full((18, kernels._padded(side)), np.nan, np.float32)
    gaussians(out, x, step, (0,) * side)
    expected = np.exp(-0.5 * np.square((x[1:17, None] - np.arange(side)) * step))
    np.testing.assert_allclose(out[1:17, :side], expected, rtol=1e-6, atol=1e-30)
    assert (out[1:17, side:] == 0).all()
    assert np.isnan(out[[0, 17]]).all()


@pytest.mark.parametrize("side", [2, 5, 11, 16, 17, 33])
@pytest.mark.parametrize("bodies", [0, 1, 4])
def test_sums_of_products_and_nothing_beside_them(side, bodies):
    rng = np.random.default_rng(side)
    factors = np.zeros((2, 6, kernels._padded(side)), np.float32)
    factors[..., :side] = rng.random((2, 6, side))
    out = np.full(side * side + 10, np.nan, np.float32)
    sum_of_products(out, 3, factors, 1, 1 + bodies, (0,) * side)
    expected = np.einsum("ia,ib->ab", *factors[:, 1 : 1 + bodies, :side])
    np.testing.assert_allclose(out[3:-7].reshape(side, side), expected, rtol=1e-6)
    assert np.isnan(out[:3]).all()
    assert np.isnan(out[-7:]).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 600), st.integers(0, 200), st.sampled_from([2, 5, 11]), st.floats(0.2, 3.0))
def test_rasterized_channels_are_those_of_numpy_whatever_they_held_before(seed, vehicles, n_bodies, side, width):
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(n_bodies, [0.6, 0.0, 0.4])
    observers = np.concatenate([np.sort(rng.integers(0, vehicles, count)) for count in counts])
    positions = rng.uniform(-0.5, 0.5, (n_bodies, 2))
    positions[rng.random(n_bodies) < 0.05] *= 1e4  # far outside the channel
    radii = np.array([0.3, 0.2, 0.5])
    sigmas = width * 2 * radii / (side - 1)
    fast, plain = (rng.normal(size=(vehicles, 3, side, side)).astype(np.float32) for _ in range(2))
    kernels.rasterize(fast, counts, observers, positions, radii, sigmas, (0,) * side)
    ends = np.cumsum(counts)
    for channel, (start, end) in enumerate(zip(ends - counts, ends, strict=True)):
        shown = observers[start:end], positions[start:end]
        observation.rasterize(plain, channel, *shown, radii[channel], sigmas[channel])
    np.testing.assert_allclose(fast, plain, rtol=5e-5, atol=1e-12)  # exponents up to 80; beyond them 0
