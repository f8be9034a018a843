import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_flock.controllers import make_controller
from sb3_flock.envs.vec_env import make_vec_env
from sb3_flock.evaluation.rollout import iter_rollout, rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, VehicleDynamics, World, episode_rng, register_dynamics
from sb3_flock.sim.dynamics import DYNAMICS, DynamicsSettings, directions_of, move, turn, wrap_angle
from tests.helpers import assert_equal_rollouts


def test_a_body_moves_along_its_present_heading():
    directions = directions_of(np.array([0.0, np.pi / 2, np.pi]))
    np.testing.assert_allclose(directions, [(1, 0), (0, 1), (-1, 0)], atol=1e-15)
    moved = move(np.array([(0.0, 0.0), (1.0, 1.0), (0.5, 0.0)]), directions, np.array([0.2, 0.1, 0.0]), dt=0.5)
    np.testing.assert_allclose(moved, [(0.1, 0.0), (1.0, 1.05), (0.5, 0.0)], atol=1e-15)


def test_a_heading_turns_by_rate_times_time_and_wraps_around():
    np.testing.assert_allclose(
        turn(np.array([0.0, 3.0, -3.0]), np.array([1.0, 2.0, -2.0]), dt=0.1), [0.1, 3.2 - 2 * np.pi, 2 * np.pi - 3.2]
    )


@given(st.floats(-1e3, 1e3))
def test_a_wrapped_angle_is_the_same_direction_within_its_half_open_interval(angle):
    wrapped = wrap_angle(np.array([angle]))
    assert -np.pi <= wrapped[0] < np.pi
    np.testing.assert_allclose(directions_of(wrapped)[0], (np.cos(angle), np.sin(angle)), atol=1e-9)


@pytest.mark.parametrize(("angle", "wrapped"), [(np.pi, -np.pi), (-np.pi, -np.pi), (0.0, 0.0)])
def test_the_ends_of_the_interval(angle, wrapped):
    assert wrap_angle(np.array(angle)) == wrapped


def test_the_number_of_bodies_in_words():
    assert DynamicsSettings().bodies == "3 vehicles, 1 obstacle"
    assert DynamicsSettings(n_vehicles=1, n_obstacles=0).bodies == "1 vehicle, 0 obstacles"


class Drifting(VehicleDynamics):
    """Vehicles drift to the left, each step farther, with noise."""

    memory = ("drifts",)
    is_random = True

    def reset(self, rngs):
        super().reset(rngs)
        self.drifts = np.zeros((len(rngs), self.settings.n_vehicles))

    def step(self, positions, headings, commands, dt):
        self.drifts = self.drifts + 0.001 * (1 + self.normal(self.settings.n_vehicles))
        left = directions_of(headings + np.pi / 2)
        return positions + self.drifts[..., None] * left, headings + 4 * commands[..., 1] * dt


@pytest.fixture
def drifting(restored):
    """A scenario with these dynamics."""
    restored(DYNAMICS)
    register_dynamics("drifting")(Drifting)
    return Scenario(n_vehicles=3, max_cycles=30, dynamics="drifting")


def test_registered_dynamics_move_the_vehicles_and_show_in_their_own_motion(drifting):
    world = World(drifting)
    world.reset([episode_rng(0, 0)])
    before = world.positions
    sensing, executed = world.step(np.full((1, 3, 2), (0.1, 3.0)))
    moved = np.linalg.norm(world.positions - before, axis=-1)
    np.testing.assert_allclose(moved, np.abs(world.dynamics.drifts))
    np.testing.assert_allclose(sensing.ego_motion[..., 2], world.dynamics.drifts)
    np.testing.assert_allclose(sensing.ego_motion[..., 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(sensing.ego_motion[..., 1], 1.2)
    assert (np.abs(world.headings) <= np.pi).all()
    np.testing.assert_array_equal(executed[0, 0], (0.1, 3.0))


def test_every_way_to_simulate_has_the_registered_dynamics(drifting):
    """The same episode alone, in a batch, and step by step."""
    controller = make_controller("go-to-waypoint")
    many, few = (rollout(controller, drifting, 4, 0, batch) for batch in (4, 1))
    for name in many:
        np.testing.assert_array_equal(many[name], few[name])
    plain = rollout(controller, drifting.replace(dynamics="unicycle"), 4, 0)
    assert (many["tracking_error"] != plain["tracking_error"]).all()
    *_, last = iter_rollout(controller, drifting)
    assert last.dynamics.drifts.any()


def test_a_vector_env_continues_from_its_state(drifting):
    one, other = (make_vec_env(drifting, n_flocks=2, seed=seed) for seed in (0, 1))
    one.reset()
    other.reset()
    for _ in range(5):
        one.step(np.zeros((6, 2), np.float32))
    other.load_state_dict(one.state_dict())
    for _ in range(10):  # the episode goes on
        ours, theirs = one.step(np.zeros((6, 2), np.float32)), other.step(np.zeros((6, 2), np.float32))
        np.testing.assert_array_equal(ours[0], theirs[0])
    assert_equal_rollouts(make_vec_env(drifting, 2, seed=3), make_vec_env(drifting, 2, seed=3), 35)


def test_an_unknown_name_is_refused_with_the_nearest(drifting):
    with pytest.raises(
        SettingsError,
        match=r"dynamics = driftin: .*registered are mujoco, navground, unicycle, drifting; did you mean drifting\?",
    ):
        Scenario(dynamics="driftin")


def test_a_name_is_registered_once_and_only_for_a_subclass(drifting):
    with pytest.raises(ValueError, match="dynamics 'unicycle' are registered already"):
        register_dynamics("unicycle")(Drifting)
    with pytest.raises(ValueError, match="a subclass of VehicleDynamics is needed"):
        register_dynamics("other")(int)


def test_a_step_that_returns_something_else_is_one_line(drifting, monkeypatch):
    world = World(drifting)
    world.reset([episode_rng(0, 0)])
    monkeypatch.setattr(Drifting, "step", lambda self, positions, headings, commands, dt: (positions[0], headings))
    with pytest.raises(ValueError, match=r"dynamics = drifting: its step returns positions of shape \(3, 2\)"):
        world.step(np.zeros((1, 3, 2)))
    monkeypatch.setattr(Drifting, "step", lambda self, positions, headings, commands, dt: (positions, headings * np.nan))
    with pytest.raises(ValueError, match=r"its step returns headings of shape \(1, 3\): finite ones"):
        world.step(np.zeros((1, 3, 2)))


def test_the_minimum_speed_is_at_most_the_top_speed():
    with pytest.raises(SettingsError, match=r"actuators.min_speed = 0.2: input should be at most max_speed = 0.15"):
        Scenario(actuators={"min_speed": 0.2})
