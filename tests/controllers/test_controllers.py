import sys

import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers import CONTROLLERS, make_controller
from sb3_flock.evaluation import fly
from sb3_flock.settings import SettingsError


@pytest.fixture(params=CONTROLLERS)
def controller(request):
    if request.param == "orca":
        pytest.importorskip("pyrvo")
    return make_controller(request.param)


def test_numbers_repeat_and_do_not_depend_on_the_batch(controller):
    scenario = Scenario(n_vehicles=4, n_obstacles=2, max_cycles=60)
    one, other, again = (fly(controller, scenario, 6, seed=3, batch=batch) for batch in (6, 4, 6))
    for name, values in one.items():
        np.testing.assert_allclose(values, other[name], rtol=1e-4, err_msg=name)  # RVO2 computes in single precision
        np.testing.assert_array_equal(values, again[name], err_msg=name)


def test_any_numbers_of_bodies_fly(controller):
    for vehicles, obstacles in ((1, 0), (1, 3), (9, 0)):
        values = fly(controller, Scenario(n_vehicles=vehicles, n_obstacles=obstacles, max_cycles=10), 2, seed=0)
        assert np.isfinite(values["tracking_error"]).all()


TIGHT = {"neighbor_violation_rate": (0.0, 0.005), "obstacle_violation_rate": (0.0, 0.005)}


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("go-to-waypoint", {"tracking_error": (0.0, 0.01), "neighbor_violation_rate": (0.5, 1.0)}),
        ("random", {"tracking_error": (0.5, 2.0), "connectivity": (0.0, 0.01)}),
        ("olfati-saber", {"tracking_error": (0.06, 0.1), "connectivity": (0.8, 1.0), **TIGHT}),
        ("orca", {"tracking_error": (0.06, 0.09), "connectivity": (0.95, 1.0), **TIGHT}),
    ],
)
def test_each_does_what_it_is_made_for(name, limits):
    if name == "orca":
        pytest.importorskip("pyrvo")
    metrics = evaluate(make_controller(name), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    for metric, (low, high) in limits.items():
        assert low <= metrics[metric].mean <= high, metric


def test_an_unknown_name_and_a_missing_library_are_told_in_one_line(monkeypatch):
    with pytest.raises(SettingsError, match=r"controller = 'boids': one of random, go-to-waypoint, olfati-saber, orca"):
        make_controller("boids")
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    with pytest.raises(SettingsError, match="needs pyrvo"):
        make_controller("orca")
