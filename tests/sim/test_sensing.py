import numpy as np
import pytest

from sb3_flock.sim import sense
from sb3_flock.sim.sensing import is_connected


def test_the_body_frame_has_forward_on_x_and_left_on_y(scenario, place):
    # Vehicle 0 looks north: the vehicle east of it is on its right, the obstacle north of it ahead.
    world = place(scenario, [(0.0, 0.0), (0.1, 0.0)], [np.pi / 2, 0.0], obstacles=[(0.0, 0.2)], waypoint=(-0.3, 0.0))
    sensing = sense(world)
    np.testing.assert_allclose(sensing.neighbor_positions[0, 0, 1], (0.0, -0.1), atol=1e-15)
    np.testing.assert_allclose(sensing.neighbor_positions[0, 1, 0], (-0.1, 0.0), atol=1e-15)
    np.testing.assert_allclose(sensing.obstacle_positions[0, 0, 0], (0.2, 0.0), atol=1e-15)
    np.testing.assert_allclose(sensing.waypoint_positions[0, 0], (0.0, 0.3), atol=1e-15)
    np.testing.assert_allclose(sensing.waypoint_distances[0], (0.3, 0.4))


def test_graphs_take_strictly_closer_bodies_and_never_the_vehicle_itself(scenario, place):
    wide = scenario.replace(link_range=0.25, detection_range=0.5, neighbor_separation=0.1)
    world = place(wide, [(0.0, 0.0), (0.25, 0.0), (0.0, 0.125)], [0.0] * 3, obstacles=[(0.0, -0.5), (0.0, -0.25)])
    sensing = sense(world)
    np.testing.assert_array_equal(sensing.neighbors[0], [[0, 0, 1], [0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(sensing.detections[0, 0], [0, 1])
    assert np.isinf(sensing.neighbor_distances[0].diagonal()).all()


def test_one_vehicle_and_no_obstacle_leave_empty_graphs(scenario, place):
    sensing = sense(place(scenario, [(0.0, 0.0)], [0.0]))
    assert sensing.neighbors.sum() == 0
    assert sensing.detections.shape == (1, 1, 0)
    assert sensing.waypoint_distances[0, 0] == 0.0


@pytest.mark.parametrize(
    ("links", "n", "connected"),
    [
        ([], 1, True),
        ([], 2, False),
        ([(0, 1)], 2, True),
        ([(0, 1), (2, 3)], 4, False),
        ([(i, i + 1) for i in range(8)], 9, True),
    ],
)
def test_connectivity_of_chains_and_islands(links, n, connected):
    graph = np.zeros((2, n, n), dtype=bool)
    for i, j in links:
        graph[:, i, j] = graph[:, j, i] = True
    np.testing.assert_array_equal(is_connected(graph), [connected, connected])
