"""Products by torch's BLAS equal NumPy's."""

import numpy as np
import pytest

pytest.importorskip("numba")

from sb3_flock.rl import blas_kernels as blas


@pytest.mark.parametrize("rows", [1, 60, 3000])
def test_products(rows):
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal(shape).astype(np.float32) for shape in ((rows, 20), (30, 20)))
    out = np.full((rows, 30), np.nan, np.float32)
    blas.product_transposed(a, b, out)
    np.testing.assert_allclose(out, a @ b.T, rtol=1e-4, atol=2e-5)
    out[:] = np.nan
    blas.product(a, np.ascontiguousarray(b.T), out)
    np.testing.assert_allclose(out, a @ b.T, rtol=1e-4, atol=2e-5)
    gradient = np.full((20, 30), np.nan, np.float32)
    blas.transposed_product(a, out, gradient)
    np.testing.assert_allclose(gradient, a.T.astype(np.float64) @ out, rtol=1e-4, atol=1e-2)


def test_a_part_of_a_matrix_is_written_alone():
    out = np.zeros((4, 3), np.float32)
    blas.product(np.ones((2, 5), np.float32), np.ones((5, 3), np.float32), out[1:3])
    assert out.tolist() == [[0, 0, 0], [5, 5, 5], [5, 5, 5], [0, 0, 0]]


def test_without_sgemm_there_is_no_compiled_update(monkeypatch, tmp_path):
    (tmp_path / "lib").mkdir()
    monkeypatch.setattr(blas.th, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(ImportError, match="torch's library has no sgemm_"):
        blas._find_sgemm()
