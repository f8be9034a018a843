"""The scripts beside the benchmarks import, and print their help without a measurement."""

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
WITH_HELP = ("sweep_scale", "time_to_paper", "tune_controllers", "peers/learning", "peers/training", "peers/worlds")
OTHERS = ("full_sight", "plot_crowd", "value_of_spacing")
PARTS = ("products", "peers/flax_networks")
"""Modules that benchmarks import."""


def run(*words):
    return subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, timeout=120, check=False)


def test_every_script_is_listed():
    scripts = [path.relative_to(HERE).with_suffix("").as_posix() for path in HERE.rglob("*.py")]
    scripts = {name for name in scripts if not name.startswith(("test_", "conftest", "__init__"))}
    assert scripts == {*WITH_HELP, *OTHERS, *PARTS}


@pytest.mark.parametrize("name", WITH_HELP)
def test_a_script_prints_its_help(name):
    done = run(HERE / f"{name}.py", "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


@pytest.mark.parametrize("name", OTHERS)
def test_a_script_imports(name):
    done = run("-c", f"import runpy; assert callable(runpy.run_path({str(HERE / f'{name}.py')!r})['main'])")
    assert done.returncode == 0, done.stderr
