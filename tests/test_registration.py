import subprocess
import sys

import pytest

MAKE = "assert pettingzoo.make('parallel', 'flock/flocking-v0', n_vehicles=4).possible_agents[3] == 'vehicle_3'"


@pytest.mark.parametrize(
    "lines",
    [
        ["import sb3_flock", "assert 'pettingzoo' not in sys.modules", "import pettingzoo", MAKE],
        ["import pettingzoo", "import sb3_flock", MAKE],
        ["import sb3_flock", "import pettingzoo.utils", "import pettingzoo", MAKE],
        ["import sb3_flock", "import importlib.util as u", "assert u.find_spec('pettingzoo')", "import pettingzoo", MAKE],
        ["import sb3_flock", "importlib.reload(sb3_flock)", "import pettingzoo", "importlib.reload(sb3_flock)", MAKE],
        ["import sb3_flock", "import pettingzoo", "importlib.reload(pettingzoo)", MAKE],
    ],
)
def test_the_environment_is_registered_in_whatever_order_the_packages_are_imported(lines):
    code = "\n".join(["import importlib", "import sys", *lines])
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_pettingzoo_is_loaded_by_its_own_loader_and_may_be_absent():
    code = """
import sys
import sb3_flock
import pettingzoo
assert type(pettingzoo.__loader__) is type(pettingzoo.__spec__.loader) is type(pettingzoo.utils.__loader__)
for name in [name for name in sys.modules if name.startswith("pettingzoo")]:
    del sys.modules[name]
sys.path.clear()
try:
    import pettingzoo
except ModuleNotFoundError as error:
    sys.exit(error.name != "pettingzoo")
sys.exit("imported from nowhere")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
