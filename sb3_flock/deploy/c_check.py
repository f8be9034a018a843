"""The compiled C of a policy in this process, with the interface of an ONNX session, for its comparison with the policy."""

from __future__ import annotations

import contextlib
import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flock.deploy.onnx_safety import filter_shapes
from sb3_flock.settings import RunError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from sb3_flock.deploy.onnx_check import SampleInput
    from sb3_flock.sim import Scenario

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
N_BODIES = (16, 8)
"""Most neighbors and obstacles of an input, as in the file."""


def compiler() -> str | None:
    """The path of a C compiler, or ``None``."""
    return next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)


@contextlib.contextmanager
def library_of(source: str, scenario: Scenario, n_bodies: tuple[int, int] = N_BODIES) -> Iterator[CLibrary]:
    """Compile a file and load it, as long as the context lasts.

    :param n_bodies: most neighbors and obstacles of an input
    :raises RunError: if it does not compile
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # Windows keeps a loaded library
        written, library = Path(folder, "policy.c"), Path(folder, "policy.so")
        written.write_text(source, "ascii")
        sizes = [f"-DFLOCK_MAX_{name}={n}" for name, n in zip(("NEIGHBORS", "OBSTACLES"), n_bodies, strict=True)]
        words = [compiler() or "cc", *FLAGS, *sizes, "-shared", "-fPIC", str(written), "-o", str(library), "-lm"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RunError(f"the C compiler failed: {' '.join(done.stderr.split())[:500]}")
        yield CLibrary(library, scenario, n_bodies)


class CLibrary:
    """The functions of a compiled file, and the types of its structs.

    :param path: the shared library
    :param scenario: the task that it was written for
    :param n_bodies: most neighbors and obstacles of an input
    """

    def __init__(self, path: Path, scenario: Scenario, n_bodies: tuple[int, int] = N_BODIES) -> None:
        self.functions = ctypes.CDLL(str(path))
        self.scenario = scenario
        n_neighbors, n_obstacles = n_bodies
        measurement = np.dtype(
            [
                ("n_neighbors", "i4"),
                ("n_obstacles", "i4"),
                ("neighbors", "f4", (n_neighbors, 2)),
                ("obstacles", "f4", (n_obstacles, 2)),
                ("waypoint", "f4", 2),
            ]
        )
        fields: list[Any] = [("now", measurement)]
        if scenario.motion_lag:
            fields += [("previous", measurement), ("ego_motion", "f4", 3)]
        needed = filter_shapes(scenario)
        fields += [(name, "f4", n_neighbors) for name in ("neighbor_headings", "neighbor_stds") if name in needed]
        if "own_speed" in needed:
            fields += [("own_speed", "f4")]
        outputs = ["speed", "turn_rate"]
        if scenario.is_filtered:
            outputs += ["asked_speed", "asked_turn_rate"]
        if scenario.safety_filter == "announce":
            outputs += ["announced_speed"]
        self.input, self.output = np.dtype(fields), np.dtype([(name, "f4") for name in outputs])
        self.announced = np.dtype(("f4", n_neighbors))

    def call(self, function: str, inputs: NDArray[Any], *others: NDArray[Any]) -> list[int]:
        """Call a function with each row of its structs; what it returns."""
        called, arrays = getattr(self.functions, function), (inputs, *others)
        steps = [array.strides[0] for array in arrays]
        starts = [array.ctypes.data for array in arrays]
        return [
            called(*(ctypes.c_void_p(start + i * step) for start, step in zip(starts, steps, strict=True)))
            for i in range(len(inputs))
        ]

    def struct_of(self, inputs: SampleInput) -> NDArray[Any]:
        """One input as a row of its struct."""
        struct = np.zeros(1, self.input)
        for prefix, measurement in (("", "now"), ("previous_", "previous")):
            for name in ("neighbors", "obstacles", "waypoint"):
                if prefix + name in inputs:
                    _fill(struct[0][measurement], name, inputs[prefix + name])
        if "ego_motion" in inputs:
            struct["ego_motion"] = inputs["ego_motion"]
        for name in ("neighbor_headings", "neighbor_stds"):
            if name in inputs:
                struct[name][0, : len(inputs[name])] = inputs[name]
        if "own_speed" in inputs:
            struct["own_speed"] = inputs["own_speed"]
        return struct

    def latency(self, samples: Iterable[SampleInput]) -> float:
        """Median time of a call of ``flock_decide`` [s]."""
        output, times = np.zeros(1, self.output), []
        for struct in [self.struct_of(inputs) for inputs in samples]:
            start = time.perf_counter()
            self.call("flock_decide", struct, output)
            times.append(time.perf_counter() - start)
        return float(np.median(times))

    def run(self, names: Sequence[str] | None, inputs: SampleInput) -> list[NDArray[np.float32]]:
        """Outputs by name, as an ONNX session gives them; all of them for ``None``."""
        struct, output = self.struct_of(inputs), np.zeros(1, self.output)
        self.call("flock_decide", struct, output)
        if "neighbor_announced_speeds" in inputs:
            announced = np.zeros((1, *self.announced.shape), np.float32)
            announced[0, : len(inputs["neighbor_announced_speeds"])] = inputs["neighbor_announced_speeds"]
            self.call("flock_raise_speed", struct, announced, output)
        results = {"action": np.array([output["speed"][0], output["turn_rate"][0]])}
        if self.scenario.safety_filter == "announce":
            results["announced_speed"] = output["announced_speed"][0]
        return [results[name] for name in (results if names is None else names)]


def _fill(measurement: Any, name: str, points: NDArray[np.float64]) -> None:
    """Write points into a struct of a measurement."""
    if name == "waypoint":
        measurement[name] = points
    else:
        measurement[name][: len(points)] = points
        measurement[f"n_{name}"] = len(points)
