"""What every simulator of the package has to do; its test module subclasses :class:`SimulatorContract`."""

import json
import math

import numpy as np
import pytest

from sb3_flock.cli import main
from sb3_flock.controllers import make_controller
from sb3_flock.evaluation.rollout import iter_rollout, rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World
from sb3_flock.sim.simulators import SIMULATORS


def simulate(name, starts, commands, **changes):
    """Speeds ``(steps, vehicles)`` and poses ``(steps, vehicles, 3)`` of a flock whose vehicles all have the same commands."""
    simulator = SIMULATORS[name](Scenario(n_vehicles=len(starts), **changes), 1)
    simulator.reset(np.array([starts], dtype=float))
    poses, speeds = [], []
    for command in commands:
        poses.append(simulator.step(np.full((1, len(starts), 2), command))[0])
        speeds.append(simulator.speeds()[0])
    return np.array(speeds), np.array(poses)


class SimulatorContract:
    """Tests of a simulator by its name."""

    name: str

    def test_poses_are_those_given_and_stay_without_a_command(self):
        starts = [(0.3, -0.2, 0.0), (-1.0, 0.5, 3.0), (0.0, 0.0, -1.5)]
        speeds, poses = simulate(self.name, starts, [(0, 0)] * 10)
        np.testing.assert_allclose(poses[0], starts, atol=1e-6)
        np.testing.assert_allclose(poses[-1], starts, atol=1e-5)
        np.testing.assert_allclose(speeds, 0.0, atol=1e-6)

    def test_a_straight_command_moves_straight_ahead(self):
        speeds, poses = simulate(self.name, [(0.0, 0.0, 1.0)], [(0.1, 0.0)] * 20)
        np.testing.assert_allclose(speeds[2:], 0.1, atol=1e-3)
        way = math.hypot(*poses[-1, 0, :2])
        assert 0.197 < way <= 0.2001
        np.testing.assert_allclose(poses[-1, 0], (way * math.cos(1.0), way * math.sin(1.0), 1.0), atol=1e-3)

    def test_a_positive_turn_rate_turns_left_on_a_circle(self):
        _, poses = simulate(self.name, [(0.0, 0.0, 0.0)], [(0.1, 1.0)] * 10)
        assert poses[-1, 0, 2] == pytest.approx(1.0, abs=0.03)
        np.testing.assert_allclose(poses[-1, 0, :2], 0.1 * np.array((math.sin(1.0), 1 - math.cos(1.0))), atol=4e-3)

    def test_vehicles_that_touch_do_not_pass_through_each_other(self):
        _, poses = simulate(self.name, [(0.0, 0.0, 0.0), (0.15, 0.0, math.pi)], [(0.15, 0.0)] * 20)
        assert poses[-1, 1, 0] - poses[-1, 0, 0] > 0.065

    def test_the_same_seed_gives_the_same_bits_in_any_batch(self):
        scenario = Scenario(dynamics=self.name, max_cycles=15, safety_filter="voronoi")
        controller = make_controller("go-to-waypoint")
        one, again, alone = (rollout(controller, scenario, 3, 1, batch) for batch in (3, 3, 1))
        for name in one:
            np.testing.assert_array_equal(one[name], again[name])
            np.testing.assert_array_equal(one[name], alone[name])

    def test_the_bodies_that_no_simulator_moves_are_as_without_one(self):
        worlds = [
            list(iter_rollout(make_controller("go-to-waypoint"), Scenario(dynamics=dynamics, max_cycles=10)))[-1]
            for dynamics in (self.name, "unicycle")
        ]
        for name in ("obstacle_positions", "obstacle_headings", "waypoints"):
            np.testing.assert_array_equal(getattr(worlds[0], name), getattr(worlds[1], name))
        np.testing.assert_allclose(worlds[0].positions, worlds[1].positions, atol=0.02)
        assert (worlds[0].positions != worlds[1].positions).all()

    def test_a_time_step_that_does_not_divide_is_one_line(self):
        with pytest.raises(SettingsError, match=f"time_step = 0.033: the simulator {self.name} needs a multiple of 0.01 s"):
            World(Scenario(dynamics=self.name, time_step=0.033))

    def test_evaluate_and_render(self, tmp_path, capsys):
        words = ["--controller", "go-to-waypoint", "--simulator", self.name, "--set", "max_cycles=5"]
        assert main(["evaluate", *words, "-n", "2", "-o", str(tmp_path / "result.json")]) == 0
        assert json.loads((tmp_path / "result.json").read_text())["meta"]["scenario"]["dynamics"] == self.name
        assert main(["render", *words, "-o", str(tmp_path / "paths.svg")]) == 0
        assert (tmp_path / "paths.svg").stat().st_size > 0
        assert capsys.readouterr().err == ""
