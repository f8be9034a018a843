import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import Scenario, World, episode_rng, sensing
from sb3_flock.sim.sensing import Contacts, distance_blocks, find_contacts, is_connected, nearest
from tests.helpers import place


def graph(links, n, flocks=1):
    """Contacts of a graph given by undirected links, the same in every flock."""
    pairs = sorted([(i, j) for i, j in links] + [(j, i) for i, j in links])
    observers, bodies = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    observers = np.concatenate([observers + flock * n for flock in range(flocks)])
    bodies = np.tile(bodies, flocks)
    return Contacts((flocks, n), observers, bodies, np.zeros((len(bodies), 2)), np.zeros(len(bodies)))


def test_the_body_frame_has_forward_on_x_and_left_on_y(scenario):
    # Vehicle 0 looks north: the vehicle east of it is on its right, the obstacle north of it ahead.
    world = place(scenario, [(0.0, 0.0), (0.1, 0.0)], [np.pi / 2, 0.0], obstacles=[(0.0, 0.2)], waypoint=(-0.3, 0.0))
    seen = world.sense()
    np.testing.assert_array_equal(seen.neighbors.observers, [0, 1])
    np.testing.assert_allclose(seen.neighbors.positions, [(0.0, -0.1), (-0.1, 0.0)], atol=1e-15)
    np.testing.assert_allclose(seen.obstacles.positions[0], (0.2, 0.0), atol=1e-15)
    np.testing.assert_allclose(seen.waypoint_positions[0, 0], (0.0, 0.3), atol=1e-15)
    np.testing.assert_allclose(seen.waypoint_distances[0], (0.3, 0.4))


def test_graphs_take_strictly_closer_bodies_and_never_the_vehicle_itself(scenario):
    wide = scenario.replace(link_range=0.25, detection_range=0.5, neighbor_separation=0.1)
    world = place(wide, [(0.0, 0.0), (0.25, 0.0), (0.0, 0.125)], [0.0] * 3, obstacles=[(0.0, -0.5), (0.0, -0.25)])
    seen = world.sense()
    assert [bodies.tolist() for bodies in seen.neighbors.by_observer()] == [[2], [], [0]]
    assert seen.obstacles.by_observer()[0].tolist() == [1]
    np.testing.assert_array_equal(seen.neighbors.count(), [[1, 0, 1]])
    np.testing.assert_array_equal(seen.neighbors.count(closer_than=0.125), [[0, 0, 0]])
    np.testing.assert_allclose(seen.neighbors.sum(seen.neighbors.distances), [[0.125, 0.0, 0.125]])


def test_one_vehicle_and_no_obstacle_leave_empty_graphs(scenario):
    seen = place(scenario, [(0.0, 0.0)], [0.0]).sense()
    assert seen.neighbors.count().tolist() == seen.obstacles.count().tolist() == [[0]]
    assert seen.neighbors.by_observer()[0].size == 0
    assert seen.waypoint_distances[0, 0] == 0.0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 3), st.integers(1, 40), st.integers(0, 20), st.floats(0.01, 0.8))
def test_numba_all_pairs_and_the_cell_lists_are_equal_to_the_last_bit(seed, flocks, vehicles, obstacles, sensing_range):
    pytest.importorskip("numba")
    rng = np.random.default_rng(seed)
    positions, bodies = (rng.uniform(-1, 1, (flocks, count, 2)) for count in (vehicles, obstacles))
    positions[rng.random((flocks, vehicles)) < 0.05] += 1e3  # far away
    angles = rng.uniform(-np.pi, np.pi, (flocks, vehicles))
    frames = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    for exclude_self, sensed in ((True, positions), (False, bodies)):
        arguments = positions, frames, sensed, sensing_range, exclude_self
        fast, plain = (find_contacts(*arguments, use_numba=use_numba) for use_numba in (True, False))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sensing, "_FEW", -1)
            by_cells = [find_contacts(*arguments, use_numba=use_numba) for use_numba in (True, False)]
        for other in (plain, *by_cells):
            for name in ("observers", "bodies", "positions", "distances"):
                np.testing.assert_array_equal(getattr(fast, name), getattr(other, name))
        distances = np.concatenate([block for _, block in distance_blocks(positions, sensed, exclude_self)], axis=1)
        np.testing.assert_array_equal(fast.count(), (distances < sensing_range).sum(-1))


def test_ten_thousand_vehicles_sense_in_linear_memory(scenario):
    many = Scenario(n_vehicles=10_000, n_obstacles=1_000, arena=50.0, max_cycles=2)
    world = World(many)
    seen = world.reset([episode_rng(0, 0)])
    assert 0 < len(seen.neighbors.observers) < 100 * many.n_vehicles
    i = seen.neighbors.observers[0]
    there = np.linalg.norm(world.positions[0] - world.positions[0, i], axis=-1)
    assert np.flatnonzero((there < many.link_range) & (there > 0)).tolist() == seen.neighbors.by_observer()[i].tolist()


def test_distances_come_in_blocks_and_the_nearest_is_the_smallest(monkeypatch):
    rng = np.random.default_rng(0)
    positions, bodies = rng.normal(size=(2, 7, 2)), rng.normal(size=(2, 3, 2))
    expected = np.linalg.norm(bodies[:, None] - positions[:, :, None], axis=-1)
    monkeypatch.setattr(sensing, "_BLOCK", 13)  # two vehicles at a time
    blocks = list(distance_blocks(positions, bodies))
    assert [block.shape for _, block in blocks] == [(2, 2, 3)] * 3 + [(2, 1, 3)]
    np.testing.assert_allclose(np.concatenate([block for _, block in blocks], axis=1), expected)
    np.testing.assert_allclose(nearest(positions, bodies), expected.min(-1))
    apart = np.linalg.norm(positions[:, None] - positions[:, :, None], axis=-1) + 9 * np.eye(7)
    np.testing.assert_allclose(nearest(positions, positions, exclude_self=True), apart.min(-1))
    assert np.isinf(nearest(positions, np.empty((2, 0, 2)))).all()
    assert np.isinf(nearest(positions[:, :1], positions[:, :1], exclude_self=True)).all()


@pytest.mark.parametrize(
    ("links", "n", "connected"),
    [
        ([], 1, True),
        ([], 2, False),
        ([(0, 1)], 2, True),
        ([(0, 1), (2, 3)], 4, False),
        ([(i, i + 1) for i in range(8)], 9, True),
        ([(0, 8), (8, 1), (1, 7), (7, 2), (2, 6), (6, 3), (3, 5), (5, 4)], 9, True),
        ([(i, i + 1) for i in range(8) if i != 4], 9, False),
    ],
)
def test_connectivity_of_chains_and_islands(links, n, connected):
    np.testing.assert_array_equal(is_connected(graph(links, n, flocks=2)), [connected, connected])


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_neighbors_share_the_obstacles_that_they_detect(seed, compiled, monkeypatch):
    if not compiled:
        monkeypatch.setattr(sensing, "compiled", lambda *names: None)
    rng, task = np.random.default_rng(seed), Scenario(n_vehicles=6, n_obstacles=3, neighbor_separation=0.01)
    world = World(task, 4)
    world.reset([np.random.default_rng(flock) for flock in range(4)])
    world.positions, world.obstacle_positions = rng.uniform(-0.15, 0.15, (4, 6, 2)), rng.uniform(-0.4, 0.4, (4, 3, 2))
    alone = world.sense()
    world.scenario = task.replace(shared_detections=True)
    together = world.sense()

    def known(contacts):
        rows = zip(contacts.observers.tolist(), contacts.bodies.tolist(), strict=True)
        return dict(zip(rows, np.column_stack((contacts.positions, contacts.distances)).tolist(), strict=True))

    own, shared = known(alone.obstacles), known(together.obstacles)
    links = list(zip(alone.neighbors.observers.tolist(), alone.neighbors.vehicles.tolist(), strict=True))
    expected = {*own, *((i, body) for i, j in links for vehicle, body in own if vehicle == j)}
    assert list(shared) == sorted(expected)
    assert len(own) < len(shared) < 4 * 6 * 3
    assert own.items() <= shared.items()  # what a vehicle detects itself stays as it is, to the last bit
    assert all(row[2] < world.scenario.known_obstacle_range for row in shared.values())
    for (i, body), (x, y, distance) in shared.items():
        flock, vehicle = divmod(i, 6)
        offset = world.obstacle_positions[flock, body] - world.positions[flock, vehicle]
        cos, sin = world.frames[flock, vehicle]
        np.testing.assert_allclose((cos * x - sin * y, sin * x + cos * y), offset, atol=1e-12)
        assert distance == pytest.approx(np.hypot(*offset))
    np.testing.assert_array_equal(together.neighbors.distances, alone.neighbors.distances)


def test_with_shared_detections_an_obstacle_that_nobody_detects_is_unknown():
    world = World(Scenario(n_vehicles=2, n_obstacles=1, shared_detections=True))
    world.reset([np.random.default_rng(0)])
    world.positions, world.obstacle_positions = np.array([[[0.0, 0.0], [0.12, 0.0]]]), np.array([[[0.38, 0.0]]])
    assert len(world.sense().obstacles.observers) == 0
    world.obstacle_positions = np.array([[[0.36, 0.0]]])
    assert world.sense().obstacles.observers.tolist() == [0, 1]
