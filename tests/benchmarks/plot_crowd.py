"""Plot seconds per step against the number of vehicles: ``python tests/benchmarks/plot_crowd.py benchmarks.json crowd.png``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from matplotlib import pyplot as plt


def main(source: str, target: str) -> None:
    """Read pytest-benchmark's JSON and write the figure."""
    rows = [
        (row["params"]["n_vehicles"], row["extra_info"])
        for row in json.loads(Path(source).read_text())["benchmarks"]
        if row["name"].startswith("test_seconds_per_step_of_one_crowd")
    ]
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, label in (("sb3_flock", "sb3_flock"), ("vmas", "VMAS, flocking"), ("mpe2", "MPE2, simple_spread")):
        found = [(n, info if name == "sb3_flock" else info.get(name)) for n, info in rows]
        points = [(n, info["seconds_per_step"]) for n, info in found if info]
        if points:
            axes.loglog(*zip(*points, strict=True), marker="o", label=label)
    axes.axhline(0.1, color="gray", linestyle=":", label="10 Hz")
    axes.set(xlabel="vehicles in one world", ylabel="seconds per step, one core")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(target, dpi=120)


if __name__ == "__main__":
    main(*sys.argv[1:])
