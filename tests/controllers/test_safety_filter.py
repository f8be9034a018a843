import numpy as np
import pytest

from sb3_flock.controllers import Controller
from sb3_flock.controllers.olfati_saber import OlfatiSaber
from sb3_flock.controllers.safety_filter import SafetyFilter
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.settings import ActionError, SettingsError
from sb3_flock.sim import Scenario
from tests.helpers import place


class FullSpeed(Controller):
    """Drives straight ahead, faster than any vehicle can."""

    def act(self, sensing, scenario):
        return np.full((*sensing.waypoint_distances.shape, 2), (9.0, 0.0), dtype=np.float32)


class Constant(Controller):
    """The same numbers in every step."""

    def __init__(self, numbers):
        self.numbers = np.array(numbers)

    def act(self, sensing, scenario):
        return self.numbers


def test_actions_that_are_not_finite_or_of_another_shape_are_not_made_safe():
    world = place(Scenario(), [(0, 0), (1, 1)], [0, 0])
    wrong = [
        ([[[0.1, 0.0], [np.nan, 0.0]]], r"action of flock 0 vehicle 1 = \[nan, 0.0\]"),
        ([0.1, 0.0], r"the shape \(2,\)"),
    ]
    for numbers, line in wrong:
        with pytest.raises(ActionError, match=line):
            SafetyFilter(Constant(numbers)).act(world.sense(), world.scenario)


def test_obstacles_bound_no_speed_unless_the_obstacle_filter_is_on():
    world = place(Scenario(max_speed=0.15), [(0, 0)], [0], obstacles=[(0.151, 0)])
    assert SafetyFilter(FullSpeed()).act(world.sense(), world.scenario)[0, 0, 0] == pytest.approx(0.15)
    assert SafetyFilter(FullSpeed(), obstacle_filter=True).act(world.sense(), world.scenario)[0, 0, 0] <= 0.01 + 1e-9


@pytest.mark.parametrize("level", ["voronoi", "motion"])
def test_a_filtered_controller_violates_no_neighbor_separation(level):
    task = Scenario(n_vehicles=8, n_obstacles=0, motion_lag=0.2, arena=0.5)
    plain, filtered = (
        rollout(controller, task, 10, seed=0) for controller in (OlfatiSaber(), SafetyFilter(OlfatiSaber(), level))
    )
    assert plain["neighbor_violation_rate"].max() > 0
    assert filtered["neighbor_violation_rate"].max() == 0
    assert filtered["min_separation_neighbors"].min() >= task.neighbor_separation


def test_it_does_what_the_filter_of_the_world_does():
    task = Scenario(n_vehicles=5, n_obstacles=2)
    fields = {"safety_filter": "voronoi", "obstacle_filter": True, "safety_margin": 0.01}
    around = rollout(SafetyFilter(OlfatiSaber(), **fields), task, 4, seed=0)
    inside = rollout(OlfatiSaber(), task.replace(**fields), 4, seed=0)
    for name, values in inside.items():
        np.testing.assert_array_equal(around[name], values, err_msg=name)


def test_it_accepts_an_sb3_model(model):
    world = place(Scenario(), [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)], [0.0, np.pi, np.pi])
    actions = SafetyFilter(model).act(world.sense(), world.scenario)
    assert (actions[0, :, 0] == 0).all()


def test_actions_are_clipped():
    world = place(Scenario(), [(0.0, 0.0)], [0.0])
    np.testing.assert_array_equal(SafetyFilter(FullSpeed()).act(world.sense(), world.scenario), [[(0.15, 0.0)]])


def test_its_state_is_that_of_the_controller():
    world, controller = place(Scenario(), [(0.0, 0.0), (0.11, 0.0)], [0.0, 0.0]), SafetyFilter(OlfatiSaber())
    controller.reset([np.random.default_rng(0)], world.scenario)
    controller.act(world.sense(), world.scenario)
    other = SafetyFilter(OlfatiSaber())
    other.load_state_dict(controller.state_dict())
    np.testing.assert_array_equal(other.state_dict()["velocities"], controller.controller._velocities)


@pytest.mark.parametrize("level", ["heading", "announce", "off"])
def test_a_controller_senses_no_headings(level):
    with pytest.raises(SettingsError, match=f"safety_filter = '{level}': a controller needs one of voronoi, motion"):
        SafetyFilter(FullSpeed(), level)


def test_ranges_that_are_too_short_are_one_line():
    with pytest.raises(SettingsError, match="link_range"):
        SafetyFilter(FullSpeed(), safety_margin=0.03).reset([], Scenario())
