import sys

import numpy as np
import pytest

from sb3_flock import make_vec_env
from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import make_controller
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Simulator, World, episode_rng, register_simulator
from sb3_flock.sim.dynamics import DYNAMICS
from sb3_flock.sim.simulators import SIMULATORS, import_extra
from sb3_flock.sim.unicycle import Unicycle
from tests.helpers import place


class Unicycles(Simulator):
    """The paper's unicycles behind the interface, with headings that are not wrapped."""

    def reset(self, poses):
        self.resets = getattr(self, "resets", 0) + 1
        self.poses = poses.copy()
        self.dynamics = Unicycle(self.settings)
        self.dynamics.reset([episode_rng(0, 0)] * self.n_flocks)

    def step(self, commands):
        dt = self.settings.time_step
        positions, headings = self.dynamics.step(self.poses[..., :2], self.poses[..., 2], commands, dt)
        self.poses = np.concatenate((positions, headings[..., None]), axis=-1)
        return np.add(self.poses, (0, 0, 2 * np.pi))


@pytest.fixture
def registered(restored):
    """A function that registers a subclass of :class:`Unicycles` with other attributes as ``fake``."""
    restored(DYNAMICS, SIMULATORS)

    def register(**attributes):
        return register_simulator("fake")(type("Fake", (Unicycles,), attributes))

    return register


def test_the_papers_unicycles_behind_the_interface_give_the_papers_numbers(registered):
    registered()
    scenario = Scenario(n_vehicles=4, max_cycles=40, safety_filter="announce", actuators={"max_acceleration": 0.5})
    controller = make_controller("go-to-waypoint")
    ours, theirs = (rollout(controller, scenario.replace(dynamics=name), 3, 0) for name in ("unicycle", "fake"))
    for name in ("tracking_error", "min_separation_obstacles", "connectivity"):
        np.testing.assert_allclose(theirs[name], ours[name], atol=0.02)
    alone = rollout(controller, scenario.replace(dynamics="fake"), 3, 0, batch=1)
    for name, values in rollout(controller, scenario.replace(dynamics="fake"), 3, 0).items():
        np.testing.assert_array_equal(values, alone[name])


def test_the_world_has_the_simulators_poses_and_resets_it_where_they_are_changed(registered):
    registered()
    world = place(Scenario(dynamics="fake"), [(0, 0), (0.5, 0)], [0, 3.1])
    _, executed = world.step([[(0.1, 0.5), (0.1, 1.0)]])
    simulator = world.dynamics._simulator
    np.testing.assert_allclose(world.positions[0], [(0.01, 0), (0.5 + 0.01 * np.cos(3.1), 0.01 * np.sin(3.1))])
    np.testing.assert_allclose(world.headings[0], [0.05, 3.2 - 2 * np.pi])
    world.step(executed)
    assert simulator.resets == 1
    world.positions += 0.2
    before = world.positions.copy()
    world.step(np.zeros((1, 2, 2)))
    assert simulator.resets == 2
    np.testing.assert_array_equal(world.positions, before)
    world.reset([episode_rng(0, 0)])
    world.step(np.zeros((1, 2, 2)))
    assert world.dynamics._simulator is simulator
    assert simulator.resets == 3


def test_a_restored_state_continues_from_its_poses_at_rest(registered):
    registered()
    scenario = Scenario(dynamics="fake", actuators={"max_acceleration": 0.4})
    world, other = place(scenario, [(0, 0), (0.5, 0)], [0, 1]), World(scenario.replace(n_vehicles=2, n_obstacles=0))
    world.step([[(0.15, 0.0), (0.0, 1.0)]])
    other.load_state_dict(world.state_dict())
    np.testing.assert_array_equal(other.dynamics.stopping().speeds, world.dynamics.stopping().speeds)
    other.step(np.zeros((1, 2, 2)))
    np.testing.assert_array_equal(other.positions, world.positions)


def test_the_filter_has_the_mean_speed_of_a_step_or_the_simulators_own(registered):
    fake = registered()
    world = place(Scenario(dynamics="fake", actuators={"max_acceleration": 0.4}), [(0, 0), (0.5, 0)], [0, 0])
    np.testing.assert_array_equal(world.dynamics.stopping().speeds, 0.0)
    world.step([[(0.15, 0.0), (0.0, 1.0)]])
    speeds, lag, bound = world.dynamics.stopping()
    np.testing.assert_allclose(speeds, [[0.02, 0.0]], atol=1e-12)  # from 0 to 0.04 m/s in the step
    assert (lag, bound) == (0.0, 0.4)
    fake.speeds = lambda self: np.array([[0.04, -0.01]])
    world.step([[(0.0, 0.0), (0.0, 0.0)]])
    np.testing.assert_array_equal(world.dynamics.stopping().speeds, [[0.04, 0.0]])


def test_the_filter_keeps_a_simulators_margin_beyond_the_scenarios(registered):
    """Two vehicles head for each other: where they stop is the separation with both margins."""
    registered(margin=0.004)
    for name, gap in (("unicycle", 0.103), ("fake", 0.107)):
        scenario = Scenario(dynamics=name, n_obstacles=0, safety_filter="heading", safety_margin=0.003)
        world = place(scenario.replace(n_vehicles=2), [(0, 0), (0.14, 0)], [0, -np.pi])
        for _ in range(30):
            world.step([[(0.15, 0.0)] * 2])
        assert np.ptp(world.positions[0, :, 0]) == pytest.approx(gap, abs=1e-5)
    assert world.safety.safety_margin == 0.003


def test_what_a_simulator_does_not_have_is_one_line(registered):
    registered(period=0.03, actuators=("min_speed",))
    with pytest.raises(SettingsError, match=r"^time_step = 0.1: the simulator fake needs a multiple of 0.03 s$"):
        World(Scenario(dynamics="fake"))
    World(Scenario(dynamics="fake", time_step=0.09, actuators={"min_speed": 0.1}))
    with pytest.raises(SettingsError, match=r"^actuators.slip = 0.1: of the actuators the simulator fake has min_speed$"):
        World(Scenario(dynamics="fake", time_step=0.09, actuators={"slip": 0.1}))
    with pytest.raises(SettingsError, match="randomization: the simulator fake has the same actuators in all flocks"):
        make_vec_env(Scenario(dynamics="fake", time_step=0.09), randomization={"actuators.min_speed": (0, 0.1)}).reset()


def test_poses_of_another_shape_are_refused(registered):
    registered(step=lambda self, commands: self.poses[..., :2])
    world = place(Scenario(dynamics="fake"), [(0, 0), (0.5, 0)], [0, 0])
    with pytest.raises(
        ValueError, match=r"dynamics = fake: its step returns poses of shape \(1, 2, 2\): \(1, 2, 3\) is needed"
    ):
        world.step(np.zeros((1, 2, 2)))


def test_a_name_is_registered_once_and_only_for_a_simulator(registered):
    with pytest.raises(ValueError, match="'unicycle' are registered already"):
        register_simulator("unicycle")(Unicycles)
    assert register_simulator("mujoco")(SIMULATORS["mujoco"]) is SIMULATORS["mujoco"]
    with pytest.raises(ValueError, match="'mujoco' are registered already"):
        register_simulator("mujoco")(Unicycles)
    with pytest.raises(ValueError, match="simulator 'other': a subclass of Simulator is needed"):
        register_simulator("other")(int)


def test_no_training_is_in_a_simulator():
    with pytest.raises(SettingsError, match="scenario.dynamics = mujoco: the state of a simulator is in no checkpoint"):
        TrainingConfig(scenario={"dynamics": "mujoco"})


@pytest.mark.parametrize(("name", "module"), [("mujoco", "mujoco"), ("navground", "navground.core")])
def test_a_missing_library_is_one_line_with_its_extra(name, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SettingsError, match=rf"dynamics = {name}: {module} is needed: pip install 'sb3_flock\[{name}\]'"):
        World(Scenario(dynamics=name)).reset([episode_rng(0, 0)])


def test_an_import_that_fails_is_one_line(tmp_path, monkeypatch):
    """As MuJoCo's where MUJOCO_GL names a library that is not there."""
    (tmp_path / "broken_simulator.py").write_text("raise AttributeError('no OpenGL\\nmore')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SettingsError, match=r"^dynamics = mujoco: broken_simulator cannot be imported: no OpenGL$"):
        import_extra("broken_simulator", "mujoco")
