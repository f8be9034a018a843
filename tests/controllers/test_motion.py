import numpy as np
import pytest

from sb3_flock.controllers.motion import Velocities, limit, steer
from sb3_flock.sim import Scenario, World, episode_rng


@pytest.mark.parametrize(
    ("velocity", "action"),
    [
        ((0.1, 0.0), (0.1, 0.0)),
        ((9.0, 0.0), (0.15, 0.0)),
        ((0.1, 0.01), (0.1, 10 * np.arctan(0.1))),
        ((-0.1, 0.0), (0.0, np.pi)),
        ((0.0, -0.1), (0.0, -np.pi)),
        ((0.0, 1e-9), (0.0, 0.0)),
    ],
)
def test_a_unicycle_turns_to_the_desired_velocity_and_drives_the_part_that_points_ahead(velocity, action):
    np.testing.assert_allclose(steer(np.array(velocity), Scenario()), action)


def test_limit_shortens_vectors_beyond_the_length_alone():
    np.testing.assert_allclose(
        limit(np.array([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]]), 1.0), [[0.6, 0.8], [0.3, 0.4], [0.0, 0.0]]
    )


def test_velocities_are_those_that_the_world_moved_the_bodies_with():
    """A body that was sensed before has its velocity over ground, whatever the observer's own motion; a new one has 0."""
    scenario = Scenario(n_vehicles=12, n_obstacles=6, arena=0.4)
    world, velocities = World(scenario, 3), Velocities()
    sensing = world.reset([episode_rng(4, e) for e in range(3)])
    rng = np.random.default_rng(0)
    seen = np.zeros((3, 12, 6), bool)
    checked = newcomers = 0
    before = world.obstacle_positions
    for _ in range(60):
        contacts = sensing.obstacles
        found = velocities.update(contacts, 6, sensing.ego_motion, scenario.time_step)
        flocks, vehicles = np.divmod(contacts.observers, 12)
        old = seen[flocks, vehicles, contacts.bodies]
        if old.any():
            moved = ((world.obstacle_positions - before) / scenario.time_step)[flocks, contacts.bodies]
            (cos, sin), (x, y) = world.frames[flocks, vehicles].T, moved.T
            expected = np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)
            np.testing.assert_allclose(found[old], expected[old], atol=1e-12)
            checked += old.sum()
        assert (found[~old] == 0).all()
        newcomers += (~old).sum()
        seen[:] = False
        seen[flocks, vehicles, contacts.bodies] = True
        before = world.obstacle_positions
        sensing, _ = world.step(rng.uniform(world.action_low, world.action_high, (3, 12, 2)))
    assert checked > 500
    assert newcomers > 20
