import numpy as np
import pytest

from sb3_flock import flocking_v0
from tests.sim.conftest import place


def has_color(picture, color):
    return (picture == np.array(color)).all(-1).any()


def test_a_picture_shows_vehicles_obstacles_and_violations():
    env = flocking_v0.parallel_env(n_vehicles=2, n_obstacles=1, render_mode="rgb_array")
    env.reset(seed=0)
    env.world = place(env.scenario, [(-0.5, -0.5), (0.5, 0.5)], [0.0, 1.0], obstacles=[(0.5, -0.5)], waypoint=(0.0, 0.0))
    calm = env.render()
    assert calm.shape == (640, 640, 3)
    assert calm.dtype == np.uint8
    vehicle, violation, obstacle = (0, 114, 178), (213, 94, 0), (204, 121, 167)
    assert has_color(calm, vehicle)
    assert has_color(calm, obstacle)
    assert not has_color(calm, violation)
    env.world.positions[0, 1] = (-0.5, -0.45)
    assert has_color(env.render(), violation)
    env.close()


def test_up_is_up():
    env = flocking_v0.parallel_env(n_vehicles=1, n_obstacles=0, render_mode="rgb_array")
    env.reset(seed=0)
    env.world = place(env.scenario, [(0.0, 0.8)], [0.0], waypoint=(0.0, -0.8))
    rows = np.argwhere((env.render() == np.array((0, 114, 178))).all(-1))[:, 0]
    assert rows.max() < 320


def test_no_render_mode_draws_nothing():
    env = flocking_v0.parallel_env()
    env.reset(seed=0)
    assert env.render() is None


def test_human_mode_opens_a_window_and_close_closes_it():
    pygame = pytest.importorskip("pygame")
    env = flocking_v0.parallel_env(render_mode="human")
    env.reset(seed=0)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert pygame.display.get_surface().get_size() == (640, 640)
    env.close()
    assert pygame.display.get_surface() is None
