"""Fixtures of the benchmarks: the peers, which run in a Python of their own."""

import json
import os
import subprocess
from pathlib import Path

import pytest

PEERS = Path(__file__).parent / "peers"
POLICY = "ddpg"
"""The shipped policy whose flocks the benchmarks measure."""


@pytest.fixture
def peer(request):
    """A function that runs a peer's script by the Python in ``SB3_FLOCK_PEERS`` and returns its results; skips without it."""
    python = os.environ.get("SB3_FLOCK_PEERS")
    option = request.config.getoption
    if python is None or (option("benchmark_disable") and not option("benchmark_enable")):
        pytest.skip("the peers are measured only where SB3_FLOCK_PEERS names the Python of their own environment")

    def measure(script, *words):
        one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        command = [python, str(PEERS / script), *map(str, words)]
        done = subprocess.run(command, env=one_thread, capture_output=True, text=True, timeout=900, check=False)
        if done.returncode:
            pytest.skip(f"{script} {words[0]} does not run there: {done.stderr.strip().splitlines()[-1][:200]}")
        return json.loads(done.stdout.strip().splitlines()[-1])

    return measure
