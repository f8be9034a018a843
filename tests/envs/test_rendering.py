import numpy as np
import pytest

from sb3_flock import flocking_v0
from sb3_flock.envs.rendering import HEADER, SIDE, Renderer
from tests.helpers import place

VEHICLE, VIOLATION, OBSTACLE = (0, 114, 178), (213, 94, 0), (204, 121, 167)


def pixels_of(picture, color):
    """Rows and columns of a color, ``(pixels, 2)``."""
    return np.argwhere((picture == np.array(color)).all(-1))


def arena(picture):
    return picture[HEADER:]


def test_a_picture_shows_vehicles_obstacles_and_violations():
    env = flocking_v0.parallel_env(n_vehicles=2, n_obstacles=1, render_mode="rgb_array")
    env.reset(seed=0)
    env.world = place(env.scenario, [(-0.5, -0.5), (0.5, 0.5)], [0.0, 1.0], obstacles=[(0.5, -0.5)], waypoint=(0.0, 0.0))
    calm = env.render()
    assert calm.shape == (HEADER + SIDE, SIDE, 3)
    assert calm.dtype == np.uint8
    assert len(pixels_of(arena(calm), VEHICLE))
    assert len(pixels_of(arena(calm), OBSTACLE))
    assert not len(pixels_of(arena(calm), VIOLATION))
    env.world.positions[0, 1] = (-0.5, -0.45)
    close = env.render()
    assert len(pixels_of(arena(close), VIOLATION))
    assert len(pixels_of(close[: HEADER // 2], VIOLATION))  # the distance in the header, too
    env.close()


@pytest.mark.parametrize("spot", [(0.0, 0.8), (-0.7, 0.1)])
def test_a_body_is_drawn_where_it_is(spot):
    env = flocking_v0.parallel_env(n_vehicles=1, n_obstacles=0, render_mode="rgb_array")
    env.reset(seed=0)
    env.world = place(env.scenario, [spot], [0.0], waypoint=(0.0, -0.8))
    row, column = pixels_of(arena(env.render()), VEHICLE).mean(0)
    found = Renderer(env.scenario, "rgb_array", 10).position_at((column, row + HEADER))
    np.testing.assert_allclose(found, spot, atol=0.02)


def test_a_vehicle_leaves_a_trail_until_the_next_episode():
    env = flocking_v0.parallel_env(n_vehicles=1, n_obstacles=0, render_mode="rgb_array")
    env.reset(seed=0)
    start = env.render()
    for _ in range(10):
        env.step({"vehicle_0": np.array([0.15, 0.0], dtype=np.float32)})
        later = env.render()
    trail = (128, 184, 216)
    assert not len(pixels_of(start, trail))
    assert len(pixels_of(later, trail))
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), start)


@pytest.mark.parametrize("n_vehicles", [1, 60])
def test_lone_vehicles_and_crowds(n_vehicles):
    env = flocking_v0.parallel_env(n_vehicles=n_vehicles, n_obstacles=0, render_mode="rgb_array")
    env.reset(seed=0)
    assert len(pixels_of(arena(env.render()), VEHICLE)) > 30 * n_vehicles


def test_no_render_mode_draws_nothing():
    env = flocking_v0.parallel_env()
    env.reset(seed=0)
    assert env.render() is None


def test_human_mode_opens_a_window_and_close_closes_it():
    pygame = pytest.importorskip("pygame")
    env = flocking_v0.parallel_env(render_mode="human")
    env.reset(seed=0)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert pygame.display.get_surface().get_size() == (SIDE, HEADER + SIDE)
    env.close()
    assert pygame.display.get_surface() is None
