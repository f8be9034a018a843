import shutil
from pathlib import Path

import numpy as np
import pytest

from sb3_flock.deploy.c_check import CLibrary, compiler, library_of
from sb3_flock.deploy.c_export import source_of
from sb3_flock.deploy.onnx_check import decide, random_sample_inputs
from sb3_flock.serialization.load import LoadedPolicy
from sb3_flock.settings import RunError
from sb3_flock.sim import Scenario
from tests.helpers import SMALL_MODEL

needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler (cc)")


@pytest.fixture
def announcing(model):
    """The library of a policy with announcements."""
    scenario = Scenario(safety_filter="announce")
    policy = LoadedPolicy(Path("small.zip"), model.policy, SMALL_MODEL, {}, 0)
    with library_of(source_of(policy, scenario), scenario) as library:
        yield library


def test_the_first_compiler_on_the_path_is_taken(monkeypatch):
    monkeypatch.setattr(shutil, "which", {"gcc": "/bin/gcc", "clang": "/bin/clang"}.get)
    assert compiler() == "/bin/gcc"
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert compiler() is None


@needs_compiler
def test_a_file_that_does_not_compile_is_one_line():
    with pytest.raises(RunError, match="the C compiler failed: [^\n]*error") as caught, library_of("no\nC\n", Scenario()):
        pass
    assert "\n" not in str(caught.value)


@needs_compiler
def test_a_library_has_the_interface_of_a_session(announcing):
    samples = [inputs for inputs, _ in random_sample_inputs(announcing.scenario, 20, seed=0)]
    for inputs in samples:
        action, announced = decide(announcing, inputs)
        assert action.shape == (2,)
        assert 0 <= announced <= action[0] <= 0.15
        assert announcing.run(None, inputs)[1] == announced
    assert 0 < announcing.latency(samples) < 0.1


@needs_compiler
def test_an_input_is_a_row_of_the_struct(announcing):
    inputs = {"neighbors": np.ones((3, 2)), "obstacles": np.zeros((0, 2)), "waypoint": np.array([1.0, 2.0])}
    struct = announcing.struct_of({**inputs, "neighbor_headings": np.array([0.1, 0.2, 0.3])})
    assert struct["now"]["n_neighbors"] == 3
    assert struct["now"]["n_obstacles"] == 0
    assert struct["now"]["neighbors"].sum() == 6
    np.testing.assert_array_equal(struct["now"]["waypoint"], [[1, 2]])
    np.testing.assert_allclose(struct["neighbor_headings"][0, :4], [0.1, 0.2, 0.3, 0.0])


@needs_compiler
def test_the_fields_are_those_that_a_filter_needs(announcing, tmp_path):
    path = announcing.functions._name
    assert CLibrary(path, Scenario()).output.names == ("speed", "turn_rate")
    assert CLibrary(path, Scenario(motion_lag=0.2)).input.names == ("now", "previous", "ego_motion")
    with_filter = CLibrary(path, Scenario(safety_filter="announce"), (3, 2))
    assert with_filter.input["now"]["neighbors"].shape == (3, 2)
    assert with_filter.output.names[-1] == "announced_speed"
