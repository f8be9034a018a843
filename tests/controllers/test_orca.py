import sys

import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers import make_controller
from sb3_flock.controllers.orca import Orca, OrcaGains
from sb3_flock.settings import SettingsError
from sb3_flock.sim import episode_rng
from tests.helpers import place


def actions_in(world, gains=None):
    controller = Orca(gains)
    controller.reset([episode_rng(0, 0)], world.scenario)
    return controller.act(world.sense(), world.scenario)[0]


def test_a_vehicle_drives_to_the_waypoint_where_nothing_is_in_its_way():
    pytest.importorskip("pyrvo")
    world = place(Scenario(), [(0.0, 0.0)], [0.0], waypoint=(0.1, 0.0))
    np.testing.assert_allclose(actions_in(world), [(0.08, 0.0)], atol=1e-6)  # 0.8 m/s for each meter
    np.testing.assert_allclose(actions_in(world, OrcaGains(approach=0.5)), [(0.05, 0.0)], atol=1e-6)


def test_a_body_ahead_slows_a_vehicle_and_one_behind_does_not():
    pytest.importorskip("pyrvo")
    speeds = []
    for obstacle in ((0.16, 0.0), (-0.2, 0.0)):
        world = place(Scenario(), [(0.0, 0.0)], [0.0], obstacles=[obstacle], waypoint=(0.5, 0.0))
        speeds.append(actions_in(world)[0, 0])
    assert speeds[0] < 0.05
    assert speeds[1] == pytest.approx(0.15, abs=1e-6)


def test_a_flock_tracks_stays_connected_and_keeps_its_separations():
    pytest.importorskip("pyrvo")
    metrics = evaluate(Orca(), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    assert 0.06 <= metrics["tracking_error"].mean <= 0.09
    assert metrics["connectivity"].mean >= 0.95
    assert metrics["neighbor_violation_rate"].mean <= 0.005
    assert metrics["obstacle_violation_rate"].mean <= 0.005


def test_a_missing_library_is_reported_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    with pytest.raises(SettingsError, match=r"controller = 'orca': needs pyrvo, pip install 'sb3_flock\[orca\]'"):
        make_controller("orca")
