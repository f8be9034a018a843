"""Two threads of compiled code meet at every barrier."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

numba = pytest.importorskip("numba")

from sb3_flock.rl.barrier_kernels import new_barrier, wait_for_other  # noqa: E402 - after the skip

MEETINGS = 2000


@numba.njit(nogil=True)
def count_and_compare(barrier, thread, counts, work):
    """Count to :data:`MEETINGS` with the other thread; the number of meetings where the other had another count."""
    differences = 0
    for meeting in range(MEETINGS):
        for _ in range(work * (meeting % 2 == thread)):  # the threads are late in turn
            counts[thread] += 0.5 - 0.5
        counts[thread] += 1
        wait_for_other(barrier, thread)
        differences += counts[0] != counts[1]
        wait_for_other(barrier, thread)
    return differences


@pytest.mark.parametrize("work", [0, 20_000])
def test_the_threads_count_alike(work):
    barrier, counts = new_barrier(), np.zeros(2)
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(count_and_compare, barrier, 1, counts, work)
        assert count_and_compare(barrier, 0, counts, work) == 0
        assert other.result() == 0
    assert counts.tolist() == [MEETINGS, MEETINGS]
    assert barrier[:, 0].tolist() == [2 * MEETINGS, 2 * MEETINGS]
