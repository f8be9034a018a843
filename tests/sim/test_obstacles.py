import numpy as np
import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.settings import SettingsError
from sb3_flock.sim import ObstacleMotion, Scenario, World, episode_rng, register_obstacle_motion
from sb3_flock.sim.obstacles import OBSTACLE_MOTIONS


class Circles(ObstacleMotion):
    """On circles of 0.4 m around the origin, counterclockwise at 0.08 m/s."""

    speed = 0.08

    def start(self, rng, waypoint):
        angle = rng.uniform(-np.pi, np.pi)
        return 0.4 * np.array([np.cos(angle), np.sin(angle)])

    def headings(self, rng, starts, waypoint):
        return np.arctan2(starts[:, 1], starts[:, 0]) + np.pi / 2

    def controls(self, rng):
        speeds = np.full((self.settings.max_cycles, self.settings.n_obstacles), self.speed)
        return speeds, speeds / 0.4


@pytest.fixture
def registered(restored):
    restored(OBSTACLE_MOTIONS)

    def register(**attributes):
        return register_obstacle_motion("circles")(type("Registered", (Circles,), attributes))

    return register


def test_obstacles_start_and_move_as_the_class_says(registered):
    registered()
    scenario = Scenario(n_vehicles=2, n_obstacles=3, obstacle_motion="circles", max_cycles=100)
    world = World(scenario, 2)
    world.reset([episode_rng(0, 0), episode_rng(0, 1)])
    start = world.obstacle_positions
    for _ in range(100):
        world.step(np.zeros((2, 2, 2)))
    np.testing.assert_allclose(np.linalg.norm(world.obstacle_positions, axis=-1), 0.4, atol=0.01)
    turned = np.angle(
        np.exp(1j * np.diff([np.arctan2(p[..., 1], p[..., 0]) for p in (start, world.obstacle_positions)], axis=0))
    )
    np.testing.assert_allclose(turned, 0.08 * 10 / 0.4, atol=0.03)
    assert len(np.unique(start[..., 0])) == 6  # each its own, in each flock


def test_a_start_too_near_to_a_vehicle_is_drawn_again(registered):
    registered(start=lambda self, rng, waypoint: rng.uniform(-0.3, 0.3, 2))
    scenario = Scenario(n_vehicles=3, n_obstacles=3, arena=0.3, obstacle_motion="circles")
    for episode in range(20):
        world = World(scenario)
        world.reset([episode_rng(0, episode)])
        distances = np.linalg.norm(world.positions[0][:, None] - world.obstacle_positions[0], axis=-1)
        assert distances.min() >= scenario.obstacle_separation


def test_given_starts_come_first(registered):
    registered()
    world = World(Scenario(n_obstacles=2, obstacle_motion="circles", obstacle_starts=[[0.9, 0.8]]))
    world.reset([episode_rng(0, 0)])
    np.testing.assert_array_equal(world.obstacle_positions[0, 0], (0.9, 0.8))
    assert np.linalg.norm(world.obstacle_positions[0, 1]) == pytest.approx(0.4)
    assert world.obstacle_headings[0, 0] == pytest.approx(np.arctan2(0.8, 0.9) + np.pi / 2)


@pytest.mark.parametrize("speed", [-0.01, 0.11, np.nan, np.zeros(3)])
def test_controls_beyond_the_bounds_are_refused(registered, speed):
    """The filter relies on the obstacles' top speed."""
    registered(controls=lambda self, rng: (np.full((200, 1), 0.0) + speed, np.zeros((200, 1))))
    world = World(Scenario(obstacle_motion="circles"))
    with pytest.raises(
        ValueError, match=r"obstacle_motion = circles: finite speeds of shape \(200, 1\) from 0 to 0\.1 are needed"
    ):
        world.reset([episode_rng(0, 0)])


def test_crossing_obstacles_meet_the_flock_at_the_origin():
    scenario = Scenario(n_obstacles=2, obstacle_motion="crossing", max_cycles=200)
    for episode in range(10):
        world = World(scenario)
        world.reset([episode_rng(1, episode)])
        start, waypoint = world.obstacle_positions[0], world.waypoints[0]
        np.testing.assert_allclose(np.linalg.norm(start, axis=1), 1.0)
        opposite = np.arccos(start @ -waypoint / np.linalg.norm(waypoint))
        assert opposite.max() <= np.pi / 4 + 1e-6
        near, steps = np.full(2, np.inf), np.zeros(2)
        for step in range(1, 201):
            world.step(np.zeros((1, 3, 2)))
            distances = np.linalg.norm(world.obstacle_positions[0], axis=1)
            steps = np.where(distances < near, step, steps)
            near = np.minimum(near, distances)
        assert near.max() <= 0.15 * np.sqrt(2) + 0.01
        assert steps.min() >= 80
        assert steps.max() <= 185


def test_a_training_mixes_registered_motions(registered):
    registered()
    config = TrainingConfig(train_env={"obstacle_motions": ["walk", "circles"], "obstacle_arena_scale": 0.5})
    walk, circles = config.training_scenarios()
    assert (walk.obstacle_motion, walk.obstacle_half_side) == ("walk", 0.5)
    assert (circles.obstacle_motion, circles.obstacle_half_side) == ("circles", 1.0)


def test_an_unknown_motion_is_one_line_with_a_suggestion():
    with pytest.raises(
        SettingsError, match=r"obstacle_motion = crosing: .* registered are walk, crossing; did you mean crossing"
    ):
        Scenario(obstacle_motion="crosing")
    with pytest.raises(SettingsError, match="obstacle_motion = wlak: .*did you mean walk"):
        TrainingConfig(train_env={"obstacle_motions": ["wlak"]})


def test_a_name_is_registered_once_and_only_for_a_motion(registered):
    motion = registered()
    assert register_obstacle_motion("circles")(motion) is motion
    for name in ("circles", "crossing", "walk"):
        with pytest.raises(ValueError, match=f"obstacle motion '{name}' is registered already"):
            register_obstacle_motion(name)(type("Other", (Circles,), {}))
    with pytest.raises(ValueError, match="a subclass of ObstacleMotion is needed"):
        register_obstacle_motion("new")(object)
