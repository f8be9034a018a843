import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import Scenario
from sb3_flock.sim.sensing import Bodies, find_contacts
from sb3_flock.sim.visibility import in_view, occluded
from tests.helpers import place

FAR = {"link_range": 1.0, "detection_range": 1.0}


def seen(scenario, positions, headings, obstacles=()):
    """What each vehicle of one flock detects: the numbers of neighbors and of obstacles."""
    world = place(scenario, positions, headings, obstacles)
    measured = world.sensors.measure(world.sense())
    return [
        (neighbors.tolist(), known.tolist())
        for neighbors, known in zip(measured.neighbors.by_observer(), measured.obstacles.by_observer(), strict=True)
    ]


def with_sensors(**sensors):
    return Scenario(sensors=sensors, **FAR)


@pytest.mark.parametrize(
    ("angle", "degrees", "is_seen"),
    [(0.0, 90, True), (44.0, 90, True), (46.0, 90, False), (-44.0, 90, True), (-46.0, 90, False), (180.0, 359, False)],
)
def test_a_body_is_detected_within_half_the_field_of_view_on_either_side(angle, degrees, is_seen):
    """Whatever the heading; the other vehicle looks away."""
    for heading in (0.0, 2.0, -3.0):
        there = 0.3 * np.array([np.cos(heading + np.radians(angle)), np.sin(heading + np.radians(angle))])
        scenario = with_sensors(field_of_view=np.radians(degrees))
        found = seen(scenario, [(0.0, 0.0), there], [heading, heading], [0.5 * there])
        assert found[0] == (([1], [0]) if is_seen else ([], []))


def test_a_body_straight_behind_is_within_the_full_circle():
    assert seen(with_sensors(dropout=1e-12), [(0.0, 0.0), (-0.3, 0.0)], [0.0, 0.0])[0] == ([1], [])


def test_the_waypoint_is_always_known():
    world = place(with_sensors(field_of_view=0.1), [(0.0, 0.0)], [0.0], waypoint=(-0.5, 0.0))
    np.testing.assert_allclose(world.sensors.measure(world.sense()).waypoint_positions, [[(-0.5, 0.0)]])


@pytest.mark.parametrize(
    ("blocker", "is_hidden"),
    [
        ((0.2, 0.0), True),
        ((0.2, 0.04), True),
        ((0.2, 0.06), False),  # beside the line of sight
        ((0.45, 0.0), False),  # behind the body
        ((-0.2, 0.0), False),  # behind the observer
    ],
)
def test_a_body_hides_what_is_behind_it_on_the_line_of_sight(blocker, is_hidden):
    scenario = with_sensors(occlusion=0.05)
    by_obstacle = seen(scenario, [(0.0, 0.0), (0.4, 0.0)], [0.0, 0.0], [blocker])
    assert (1 not in by_obstacle[0][0]) is is_hidden
    by_vehicle = seen(scenario, [(0.0, 0.0), blocker], [1.0, 0.0], [(0.4, 0.0)])
    assert (by_vehicle[0][1] == []) is is_hidden


def test_a_vehicle_out_of_link_range_hides_an_obstacle():
    scenario = Scenario(link_range=0.15, detection_range=0.5, sensors={"occlusion": 0.05})
    assert seen(scenario, [(0.0, 0.0), (0.3, 0.0)], [0.0, 0.0], [(0.4, 0.0)])[0] == ([], [])


def test_a_hidden_body_hides_others():
    found = seen(with_sensors(occlusion=0.05), [(0.0, 0.0), (0.2, 0.0), (0.4, 0.0), (0.6, 0.0)], [0.0] * 4)
    assert [neighbors for neighbors, _ in found] == [[1], [0, 2], [1, 3], [2]]


def test_a_neighbor_shares_what_it_detects_in_its_own_field_of_view():
    """The first vehicle looks away from the obstacle, and from the second one, which shares it if it sees it itself."""
    ranges = {"link_range": 0.15, "detection_range": 0.25}
    scenario = Scenario(shared_detections=True, sensors={"field_of_view": np.pi / 2}, **ranges)
    positions, obstacle = [(0.0, 0.0), (0.14, 0.0), (0.7, 0.7)], [(0.35, 0.0)]
    assert seen(scenario, positions, [np.pi, 0.0, 0.0], obstacle)[:2] == [([], [0]), ([], [0])]
    assert seen(scenario, positions, [np.pi, np.pi, 0.0], obstacle)[:2] == [([], []), ([0], [])]
    alone = scenario.replace(shared_detections=False)
    assert seen(alone, positions, [np.pi, 0.0, 0.0], obstacle)[:2] == [([], []), ([], [0])]


def test_links_and_rewards_are_of_the_truth():
    """A vehicle that nobody sees is linked all the same."""
    world = place(with_sensors(field_of_view=0.1), [(0.0, 0.0), (0.3, 0.0)], [np.pi, 0.0])
    sensing, _ = world.step(np.zeros((1, 2, 2)))
    assert sensing.neighbors.count().tolist() == [[1, 1]]
    assert world.sensors.measure(sensing).neighbors.count().tolist() == [[0, 0]]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 8), st.integers(0, 5), st.floats(0.0, 0.3))
def test_hidden_bodies_are_those_of_the_definition_with_and_without_numba(seed, vehicles, obstacles, radius):
    rng = np.random.default_rng(seed)
    positions, there = rng.uniform(-1, 1, (2, vehicles, 2)), rng.uniform(-1, 1, (2, obstacles, 2))
    angles = rng.uniform(-np.pi, np.pi, (2, vehicles))
    bodies = Bodies(positions, np.stack((np.cos(angles), np.sin(angles)), axis=-1), there)
    everything = np.concatenate((positions, there), axis=1)
    radii = np.array([radius, 0.0])
    for are_vehicles, places in ((True, positions), (False, there)):
        contacts = find_contacts(positions, bodies.frames, places, 0.9, exclude_self=are_vehicles)
        found = occluded(contacts, are_vehicles, bodies, radii)
        np.testing.assert_array_equal(occluded(contacts, are_vehicles, bodies, radii, use_numba=False), found)
        for k, observer in enumerate(contacts.observers):
            flock, i = divmod(int(observer), vehicles)
            own = int(contacts.bodies[k]) + (0 if are_vehicles else vehicles)
            line, hidden = everything[flock, own] - positions[flock, i], False
            for other in set(range(vehicles + obstacles)) - {i, own}:
                along = (everything[flock, other] - positions[flock, i]) @ line / (line @ line)
                beside = np.linalg.norm(positions[flock, i] + along * line - everything[flock, other])
                hidden |= bool(0 < along < 1 and beside < radii[flock])
            assert found[k] == hidden


def test_each_flock_has_its_own_field_of_view():
    positions = np.zeros((2, 2, 2))
    positions[:, 1] = 0.1
    contacts = find_contacts(positions, np.tile([1.0, 0.0], (2, 2, 1)), positions, 1.0, exclude_self=True)
    assert in_view(contacts, np.array([np.pi, 0.1])).tolist() == [True, False, False, False]
