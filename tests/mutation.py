"""Mutation testing by mutmut: which small changes of the code the tests of its own package notice.

    python tests/mutation.py --mutants 150            # a sample of each package
    python tests/mutation.py sim rl --mutants 0       # all mutants of two packages

Each package is mutated in a copy of the repository, and its tests run once for each mutant, in processes forked after the
imports. Compiled code (``kernels.py``, ``*_kernels.py``) is not mutated, because numba compiles it once for all mutants, nor
are decorated functions, which mutmut passes over. Prints a table; ``--out`` is the file of the survivors' changes. Needs
``pip install mutmut``.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "sim": (),
    "envs": (),
    "rl": (),
    "serialization": (),
    "evaluation": (),
    "controllers": (),
    "training": ("test_faults.py", "test_long_run.py"),
    "sweep/statistics": (),
}
"""The packages, or modules, and those of their test files that take too long to run for each mutant."""
SURVIVED = ("survived", "no tests")
CONFIG = """
[tool.mutmut]
source_paths = ["sb3_flock"]
only_mutate = ["sb3_flock/{source}"]
do_not_mutate = ["*/kernels.py", "*_kernels.py", "*/rendering.py", "*/__init__.py"]
also_copy = ["README.md", "CONTRIBUTING.md", "configs", "examples", "docs", "sb3_flock"]
pytest_add_cli_args = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:cov"{ignored}]
pytest_add_cli_args_test_selection = ["tests/{tests}"]
process_isolation = "forkserver"
track_dependencies = false
"""


def copy_of(package: str, folder: Path) -> Path:
    """A copy of the repository's files that mutates one package."""
    copy = folder / package.replace("/", "_")
    where, _, module = package.partition("/")
    names = {
        "source": f"{where}/{module}.py" if module else f"{where}/*",
        "tests": f"{where}/test_{module}.py" if module else where,
        "ignored": "".join(f', "--ignore=tests/{where}/{name}"' for name in PACKAGES[package]),
    }
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0")
    for name in filter(None, files):
        target = copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)
    with (copy / "pyproject.toml").open("a") as file:
        file.write(CONFIG.format(**names))
    return copy


def mutmut(copy: Path, *words: str) -> str:
    """What a command of mutmut prints."""
    command = [sys.executable, "-m", "mutmut", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=copy, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return done.stdout


def statuses(copy: Path) -> dict[str, str]:
    """Every mutant's status by its name."""
    lines = (line.strip().split(": ") for line in mutmut(copy, "results", "--all", "true").splitlines())
    return {line[0]: line[1] for line in lines if len(line) == 2 and "__mutmut_" in line[0]}


def mutate(package: str, n_mutants: int, folder: Path) -> tuple[Counter[str], str]:
    """Test the mutants of a package: how many have each status, and the survivors' changes."""
    copy = copy_of(package, folder)
    mutmut(copy, "run", "none")  # makes the mutants, and runs the tests once
    names = sorted(statuses(copy))
    if not names:
        raise SystemExit(f"{package}: mutmut made no mutants; its output is that of `mutmut run` in {copy}")
    chosen = names if not n_mutants else random.Random(0).sample(names, min(n_mutants, len(names)))
    mutmut(copy, "run", *chosen)
    found = {name: status for name, status in statuses(copy).items() if name in set(chosen)}
    survivors = [mutmut(copy, "show", name) for name, status in found.items() if status in SURVIVED]
    return Counter(found.values()), "\n".join(survivors)


def main() -> None:
    """Test the packages that the command line names."""
    parser = argparse.ArgumentParser(description="Mutation testing by mutmut.")
    parser.add_argument(
        "packages", nargs="*", default=list(PACKAGES), metavar="package", help=f"of {', '.join(PACKAGES)} [all]"
    )
    parser.add_argument("--mutants", type=int, default=150, help="random mutants of each package; 0: all of them [150]")
    parser.add_argument("--out", type=Path, default=Path("survivors.diff"), help="file of the survivors [survivors.diff]")
    args = parser.parse_args()
    unknown = set(args.packages) - set(PACKAGES)
    if unknown:
        parser.error(f"package: one of {', '.join(PACKAGES)} is needed, not {', '.join(sorted(unknown))}")
    args.out.write_text("")
    print("package           killed  survived  no tests  others  score", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for package in args.packages:
            counts, survivors = mutate(package, args.mutants, Path(folder))
            left = sum(counts[status] for status in SURVIVED)
            others = counts["not checked"] + counts["suspicious"] + counts["skipped"]
            killed = counts.total() - left - others
            score = killed / max(1, killed + left)
            words = (
                f"{package:<16}",
                f"{killed:>7}",
                f"{counts['survived']:>9}",
                f"{counts['no tests']:>9}",
                f"{others:>7}",
                f"{score:>6.1%}",
            )
            print(*words, flush=True)
            with args.out.open("a") as file:
                file.write(survivors)


if __name__ == "__main__":
    main()
