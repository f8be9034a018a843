"""The tracker: exact where there is nothing to estimate, consistent where there is, and association without identities."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from sb3_flock import Scenario, flocking_v0
from sb3_flock.controllers import make_controller
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Contacts, Sensing, World, episode_rng
from sb3_flock.sim.randomization import FlockValues
from sb3_flock.sim.safety import filter_actions
from sb3_flock.sim.sensors import Sensors
from sb3_flock.sim.tracker import Messages, Tracker, Tracks, associate
from tests.helpers import assert_copy_continues_alike, place

STEP = 0.1
FIELD = {"position_noise": 0.01, "dropout": 0.1, "delay": 0.1}
CROWD = Scenario(n_vehicles=6, n_obstacles=3, arena=0.3, obstacle_arena=0.4, motion_lag=0.2, tracker={"enabled": True})


def tracker_of(sensors=None, **settings):
    """A tracker of one vehicle, or of several in flocks of one."""
    scenario = Scenario(n_vehicles=1, sensors=sensors or {}, tracker={"enabled": True, "margin_stds": 0.0, **settings})
    return Tracker(scenario.tracker, scenario, scenario, FlockValues(scenario.sensors))


def contacts(positions, shape=(1, 1), observers=None, bodies=None):
    positions = np.asarray(positions, dtype=float).reshape(-1, 2)
    observers = np.zeros(len(positions), np.int64) if observers is None else np.asarray(observers)
    bodies = np.arange(len(positions)) if bodies is None else np.asarray(bodies)
    return Contacts(shape, observers, bodies, positions, np.hypot(positions[:, 0], positions[:, 1]))


def sensed(neighbors=(), obstacles=(), waypoint=(1.0, 0.0), bodies=None):
    """What one vehicle detects."""
    places = np.array(waypoint, dtype=float).reshape(1, 1, 2)
    found = contacts(neighbors, bodies=bodies), contacts(obstacles)
    return Sensing(*found, places, np.hypot(*np.moveaxis(places, -1, 0)), np.zeros((1, 1, 2)))


def still():
    return np.zeros((1, 1, 2))


def begin(scenario, n_flocks=1):
    world = World(scenario, n_flocks)
    return world, world.reset([episode_rng(0, episode) for episode in range(n_flocks)])


# What there is to estimate is estimated exactly.


@pytest.mark.parametrize("tracker", [{}, {"shared_motion": True}])
@pytest.mark.parametrize("actuators", [{}, {"slip": 0.2, "disturbance": 0.02}])
def test_of_exact_sensors_the_estimate_is_what_is_sensed(tracker, actuators):
    scenario = CROWD.replace(actuators=actuators, tracker={"enabled": True, **tracker})
    world, truth = begin(scenario, 3)
    bare, _ = begin(scenario.replace(tracker={}), 3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        measured, expected = world.sensors.measure(truth), bare.sensors.measure(truth)
        for now, then in ((measured, expected), (measured.previous, expected.previous)):
            for ours, theirs in ((now.neighbors, then.neighbors), (now.obstacles, then.obstacles)):
                np.testing.assert_array_equal(ours.observers, theirs.observers)
                np.testing.assert_array_equal(ours.bodies, theirs.bodies)
                np.testing.assert_allclose(ours.positions, theirs.positions, atol=1e-14)
            np.testing.assert_allclose(now.waypoint_positions, then.waypoint_positions, atol=1e-14)
        assert not measured.neighbors.stds.any()
        truth, _ = world.step(rng.uniform(world.action_low, world.action_high, (3, 6, 2)))


def test_a_tracker_that_is_off_is_not_there():
    scenario = CROWD.replace(tracker={}, sensors=FIELD)
    changed = scenario.replace(tracker={"gate": 1.0, "shared_motion": True, "margin_stds": 9.0})
    results = [rollout(make_controller("orca"), task.replace(max_cycles=20), 2, 0) for task in (scenario, changed)]
    for name, values in results[0].items():
        np.testing.assert_array_equal(values, results[1][name])
    world, truth = begin(changed)
    assert world.sensors.measure(truth).neighbors.stds is None
    assert "tracker" not in world.sensors.state_dict()


def test_constant_velocities_and_own_motion_are_compensated_over_the_delay():
    """The vehicle drives in a circle. A body goes straight on; what is detected is 0.3 s old, what is estimated is of now."""
    tracker = tracker_of({"delay": 0.3}, obstacle_acceleration=1e-6)
    pose, poses, body = np.zeros(3), [], np.array([0.1, 0.05])
    velocity = np.array([-0.03, 0.06])

    def seen_from(pose, point):
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x, y = point - pose[:2]
        return [cos * x + sin * y, cos * y - sin * x]

    for step in range(25):
        poses.append(pose.copy())
        late = max(step - 3, 0)
        detected = sensed(obstacles=[seen_from(poses[late], body + velocity * STEP * late)])
        ego_motion = np.array([[[0.01, 0.2, 0.004]]]) if step else np.zeros((1, 1, 3))
        estimate = tracker.update(detected, ego_motion)
        expected = seen_from(pose, body + velocity * STEP * step)
        if step > 5:  # two detections give a velocity
            np.testing.assert_allclose(estimate.obstacles.positions, [expected], atol=1e-9)
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        pose = pose + np.array((cos * 0.01 - sin * 0.004, sin * 0.01 + cos * 0.004, 0.2))


def test_shared_motion_needs_no_velocity():
    """With messages, the second estimate is exact, although the neighbor turns and stops as it likes, and detections are late."""
    scenario = CROWD.replace(sensors={"delay": 0.2}, tracker={"enabled": True, "shared_motion": True}, arena=0.2)
    world, truth = begin(scenario.replace(actuators={"slip": 0.3}), 4)
    rng = np.random.default_rng(1)
    compared = 0
    for _ in range(20):
        found = world.sensors.measure(truth).neighbors
        keys, known = (each.observers * 6 + each.bodies for each in (truth.neighbors, found))
        rows = np.searchsorted(keys, known)
        rows[rows == len(keys)] = 0
        same = keys[rows] == known
        np.testing.assert_allclose(found.positions[same], truth.neighbors.positions[rows[same]], atol=1e-12)
        compared += same.sum()
        truth, _ = world.step(rng.uniform(world.action_low, world.action_high, (4, 6, 2)))
    assert compared > 200


def test_shared_motion_needs_messages_and_headings():
    tracker = tracker_of(shared_motion=True)
    with pytest.raises(ValueError, match="shared_motion needs what the neighbors share"):
        tracker.update(sensed(), still())
    scenario = Scenario(n_vehicles=1, tracker={"enabled": True, "shared_motion": True})
    with pytest.raises(ValueError, match="shared_motion needs to know the headings"):
        Sensors(scenario, scenario).measure(sensed())


# Statistics.


def test_estimates_are_consistent():
    """Normalized errors and innovations (NEES, NIS) of many tracks with the assumed noise have the mean of chi-squared."""
    rng, n, dt = np.random.default_rng(2), 400, STEP
    acceleration, noise = 0.2, 0.02
    scenario = Scenario(
        n_vehicles=1, obstacle_max_speed=0.2, detection_range=100.0, sensors={"position_noise": noise, "dropout": 1e-9},
        tracker={"enabled": True, "obstacle_acceleration": acceleration, "gate": 100.0},
    )  # fmt: skip
    tracker = Tracker(scenario.tracker, scenario, scenario, FlockValues(scenario.sensors))
    intensity = acceleration**2 * dt
    spread = np.linalg.cholesky(intensity * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    positions, velocities = rng.normal(size=(n, 2)), rng.normal(0, 0.1, (n, 2))
    nees, nis = [], []
    waypoints = np.zeros((n, 1, 2))
    for step in range(30):
        detected = positions + noise * rng.normal(size=(n, 2))
        found = contacts(detected, (n, 1), np.arange(n), np.zeros(n, np.int64))
        none = contacts(np.empty((0, 2)), (n, 1))
        predicted = tracker.tracks.select(tracker.tracks.labels[:, 0] // n == 1).predict(
            dt, np.full(n, intensity) if step else 0
        )
        tracker.update(Sensing(none, found, waypoints, waypoints[..., 0], np.zeros((n, 1, 2))), np.zeros((n, 1, 2)))
        tracks = tracker.tracks.select(tracker.tracks.labels[:, 0] // n == 1)
        errors = np.stack((positions - tracks.means[:, :2], velocities - tracks.means[:, 2:]), axis=-1)  # (n, axis, state)
        own, mixed, rate = tracks.covariances.T
        inverse = np.linalg.inv(np.stack((np.stack((own, mixed), -1), np.stack((mixed, rate), -1)), -2))
        if step > 1:
            nees.append(np.einsum("nai,nij,naj->n", errors, inverse, errors))
            innovations = detected - predicted.means[:, :2]
            nis.append(np.square(innovations).sum(-1) / (predicted.covariances[:, 0] + noise**2))
        drawn = rng.normal(size=(n, 2, 2)) @ spread.T
        positions, velocities = positions + dt * velocities + drawn[..., 0], velocities + drawn[..., 1]
    for values, degrees in ((nees, 4), (nis, 2)):
        mean, deviation = np.mean(values), math.sqrt(2 * degrees / np.size(values))
        assert mean == pytest.approx(degrees, abs=6 * deviation)  # errors of a track are correlated over the steps


@pytest.mark.parametrize("shared", [False, True])
def test_in_a_flock_the_errors_are_smaller_than_the_noise_and_as_large_as_stated(shared):
    scenario = CROWD.replace(sensors={"position_noise": 0.01}, tracker={"enabled": True, "shared_motion": shared})
    world, truth = begin(scenario, 40)
    controller = make_controller("olfati-saber")
    controller.reset([episode_rng(0, episode) for episode in range(40)], scenario)
    errors, stated = [], []
    for step in range(40):
        measured = world.sensors.measure(truth)
        keys, known = (each.observers * 6 + each.bodies for each in (truth.neighbors, measured.neighbors))
        rows = np.minimum(np.searchsorted(keys, known), len(keys) - 1)
        same = keys[rows] == known
        if step > 10:
            errors.append((measured.neighbors.positions - truth.neighbors.positions[rows])[same])
            stated.append(measured.neighbors.stds[same])
        truth, _ = world.step(controller.act(measured, scenario))
    error, std = np.concatenate(errors).std(), np.concatenate(stated).mean()
    assert error < (0.005 if shared else 0.0085)
    assert 0.6 < error / std < 1.1


# Association.


def test_the_nearest_pairs_are_associated_one_to_one():
    rng = np.random.default_rng(3)
    costs = []
    for _ in range(60):
        series = np.sort(rng.integers(0, 3, 7))
        tracked = np.sort(rng.integers(0, 3, 6))
        positions, means = rng.uniform(0, 0.3, (7, 2)), rng.uniform(0, 0.3, (6, 2))
        labels = np.stack((tracked, np.zeros(6, np.int64), np.zeros(6, np.int64)), -1)
        tracks = Tracks(labels, np.hstack((means, np.zeros((6, 2)))), np.full((6, 3), 1e-3))
        track, detection = associate(tracks, series, positions, np.full(7, 1e-3), np.full(7, 3.0))
        assert len(set(track)) == len(track)
        assert len(set(detection)) == len(detection)
        np.testing.assert_array_equal(tracked[track], series[detection])
        distances = np.square(means[:, None] - positions).sum(-1) / 2e-3
        distances[(tracked[:, None] != series) | (distances > 9)] = np.inf
        left = distances.copy()
        greedy = []
        while np.isfinite(left).any():  # one pair after the other
            row, column = np.unravel_index(left.argmin(), left.shape)
            greedy.append((row, column))
            left[row], left[:, column] = np.inf, np.inf
        assert set(greedy) == set(zip(track.tolist(), detection.tolist(), strict=True))
        rows, columns = linear_sum_assignment(np.minimum(distances, 9.0))
        best = np.minimum(distances, 9.0)[rows, columns].sum()
        own = distances[track, detection].sum() + 9.0 * (6 - len(track))
        costs.append(own - best)
    assert min(costs) > -1e-9
    assert np.mean(np.array(costs) < 1e-9) > 0.5


def test_crossing_bodies_keep_their_tracks():
    """Two obstacles pass each other at 0.03 m: the tracks go on with their velocities, whatever the order of the detections."""
    tracker = tracker_of({"position_noise": 0.003}, obstacle_acceleration=0.02)
    rng = np.random.default_rng(4)
    for step in range(40):
        x = 0.1 - 0.005 * step
        places = np.array([[x, 0.015], [-x, -0.015]]) + 0.003 * rng.normal(size=(2, 2))
        tracker.update(sensed(obstacles=places[:: rng.choice([-1, 1])]), still())
    tracks = tracker.tracks.select(tracker.tracks.labels[:, 0] == 1)
    assert len(tracks.labels) == 2
    order = np.argsort(tracks.means[:, 0])
    np.testing.assert_allclose(tracks.means[order, :2], [[-0.095, 0.015], [0.095, -0.015]], atol=0.006)
    np.testing.assert_allclose(tracks.means[order, 2], [-0.05, 0.05], atol=0.02)


def test_a_track_survives_missed_detections_and_ends():
    tracker = tracker_of({"dropout": 0.1}, max_missed=3)
    for step in range(10):
        tracker.update(sensed(obstacles=[(0.1 + 0.003 * step, 0.0)]), still())
    shown = [tracker.update(sensed(), still()).obstacles for _ in range(4)]
    assert [len(found.bodies) for found in shown] == [1, 1, 1, 0]
    np.testing.assert_allclose(shown[2].positions, [(0.136, 0.0)], atol=1e-3)
    assert (np.diff([found.stds[0] for found in shown[:3]]) > 0).all()  # the uncertainty grows
    assert tracker.update(sensed(obstacles=[(0.1, 0.0)]), still()).obstacles.positions.tolist() == [
        [0.1, 0.0]
    ]  # born at once


@pytest.mark.parametrize(
    ("sensors", "spot", "survives"),
    [
        ({}, (0.1, 0.0), False),
        ({"field_of_view": math.pi}, (0.1, 0.0), False),
        ({"field_of_view": math.pi}, (-0.1, 0.0), True),
    ],
)
def test_a_body_in_view_of_sensors_that_miss_nothing_is_gone(sensors, spot, survives):
    tracker = tracker_of(sensors)
    tracker.update(sensed(obstacles=[spot]), still())
    assert len(tracker.update(sensed(), still()).obstacles.bodies) == survives


def test_a_body_out_of_range_is_not_shown():
    tracker = tracker_of({"dropout": 0.1})
    for step in range(5):
        tracker.update(sensed(obstacles=[(0.2 + 0.009 * step, 0.0)]), still())
    shown = [len(tracker.update(sensed(), still()).obstacles.bodies) for _ in range(3)]
    assert shown == [1, 0, 0]  # detection_range is 0.25
    assert (tracker.tracks.labels[:, 0] == 1).sum() == 1


def test_a_detection_beyond_the_gate_starts_a_track():
    tracker = tracker_of({"position_noise": 0.001, "dropout": 0.1})
    for spot in ((0.1, 0.0), (0.1, 0.0), (0.1, 0.0), (-0.1, 0.0)):
        found = tracker.update(sensed(obstacles=[spot]), still()).obstacles
    assert len(found.bodies) == 2
    np.testing.assert_allclose(np.sort(found.positions[:, 0]), [-0.1, 0.1], atol=1e-3)


def test_identities_are_not_used():
    """With the numbers of the bodies exchanged in each step, all positions stay as they are."""
    found = []
    for turns in (itertools.repeat(1), itertools.cycle((1, -1))):
        tracker, rng = tracker_of({"position_noise": 0.01, "dropout": 0.2}), np.random.default_rng(5)
        for turn in itertools.islice(turns, 20):
            places = np.array([(0.1, 0.02), (0.05, -0.06), (-0.08, 0.0)]) + 0.01 * rng.normal(size=(3, 2))
            estimate = tracker.update(sensed(neighbors=places, bodies=np.arange(3)[::turn]), still())
        found.append(estimate.neighbors.positions[np.lexsort(estimate.neighbors.positions.T)])
    np.testing.assert_array_equal(*found)


# The filter.


def filtered_speed(stds, k=2.0, unplaced=None, **settings):
    scenario = Scenario(
        n_vehicles=2, n_obstacles=0, safety_filter="announce", tracker={"enabled": True, "margin_stds": k}, **settings
    )
    world = place(scenario, [(0, 0), (0.12, 0)], [0, 0])
    sensing = world.sense()
    neighbors = replace(sensing.neighbors, stds=stds) if unplaced is None else contacts(np.empty((0, 2)), (1, 2))
    sensing = replace(sensing, neighbors=neighbors, unplaced=unplaced)
    actions = np.array([[[0.15, 0.0], [0.0, 0.0]]])
    return filter_actions(actions, sensing, scenario, world.frames)[0, 0, 0]


def test_the_filter_keeps_standard_deviations_of_the_estimate():
    assert filtered_speed(None) == filtered_speed(np.zeros(2)) == 0.15  # the neighbor heads away: 0.02 m admit 0.2 m/s
    assert filtered_speed(np.array([0.005, 0.0])) == pytest.approx(0.1, abs=1e-6)
    assert filtered_speed(np.array([0.005, 0.0]), k=3.0) == pytest.approx(0.05, abs=1e-6)
    assert filtered_speed(np.array([0.02, 0.0])) == 0.0


@pytest.mark.parametrize("distance", [0.2, 0.01])
def test_obstacles_are_given_nearer_by_standard_deviations_of_the_estimate(distance):
    tracker = tracker_of({"position_noise": 0.01}, margin_stds=2.0)
    found = tracker.update(sensed(neighbors=[(0.12, 0)], obstacles=[(0, distance)]), still())
    np.testing.assert_allclose(found.obstacles.positions, [(0, max(distance - 0.02, 0))], atol=1e-12)
    np.testing.assert_allclose(found.obstacles.distances, [max(distance - 0.02, 0)], atol=1e-12)
    assert found.obstacles.stds == pytest.approx(0.01)
    np.testing.assert_allclose(found.neighbors.positions, [(0.12, 0)], atol=1e-12)  # the filter keeps that of neighbors
    np.testing.assert_allclose(found.waypoint_positions, [[(1.0, 0.0)]], atol=1e-12)


def test_the_obstacle_filter_keeps_the_margin_once():
    """Between the obstacle and 0.15 m are 0.03 m, less a margin of 0.02 m: the vehicle goes 0.01 m in a step, at 0.1 m/s."""
    scenario = Scenario(
        n_vehicles=1,
        obstacle_filter=True,
        obstacle_max_speed=0.0,
        tracker={"enabled": True},
        sensors={"position_noise": 0.01},
    )
    tracker = Tracker(scenario.tracker, scenario, scenario, FlockValues(scenario.sensors))
    estimate = tracker.update(sensed(obstacles=[(0.18, 0)]), still())
    assert filter_actions(np.array([[[0.15, 0.0]]]), estimate, scenario)[0, 0, 0] == pytest.approx(0.1, abs=1e-6)


def test_a_neighbor_that_is_heard_but_not_placed_is_kept_clear_of():
    assert filtered_speed(None, unplaced=np.array([True, False])) == pytest.approx(
        0.1, abs=1e-6
    )  # half of 0.15 - 0.03 - 0.1
    assert filtered_speed(None, unplaced=np.array([False, True])) == 0.15


def heard(*senders):
    """Messages that vehicle 0 of two receives."""
    return Messages(
        np.tile((1.0, 0.0), (1, 2, 1)), np.zeros((1, 2, 2)), np.zeros(len(senders), np.int64), np.array(senders, np.int64)
    )


@pytest.mark.parametrize(
    ("sensors", "patience"),
    [({}, 0), ({"delay": 0.2}, 2), ({"dropout": 0.1}, 5), ({"delay": 0.2, "dropout": 0.1, "field_of_view": 4.0}, 7)],
)
def test_a_neighbor_that_is_not_detected_in_time_is_out_of_view(sensors, patience):
    scenario = Scenario(n_vehicles=2, sensors=sensors, tracker={"enabled": True, "shared_motion": True})
    tracker = Tracker(scenario.tracker, scenario, scenario, FlockValues(scenario.sensors))
    none, waypoints = contacts(np.empty((0, 2)), (1, 2)), np.zeros((1, 2, 2))
    nothing = Sensing(none, none, waypoints, waypoints[..., 0], np.zeros((1, 2, 2)))
    assert not tracker.update(nothing, np.zeros((1, 2, 2)), heard()).unplaced.any()
    seen = [tracker.update(nothing, np.zeros((1, 2, 2)), heard(1)).unplaced.tolist() for _ in range(9)]
    assert seen == [[True, False]] * patience + [[False, False]] * (9 - patience)


def test_the_distance_that_two_vehicles_need_to_stop_is_stated():
    scenario = Scenario(
        safety_filter="announce", actuators={"speed_lag": 0.1, "max_acceleration": 0.3}, sensors={"delay": 0.2}
    )
    assert scenario.stopping_range == pytest.approx(0.1 + 2 * (0.15 * (0.1 + 0.1 + 0.2) + 0.15**2 / 0.6))
    assert any("link_range = 0.15" in limit for limit in scenario.guarantee_limits)
    cooperating = scenario.replace(tracker={"enabled": True, "shared_motion": True})  # messages are not late
    assert cooperating.stopping_range == pytest.approx(scenario.stopping_range - 2 * 0.15 * 0.2)
    assert any("link_range" in limit for limit in cooperating.guarantee_limits)
    wide = cooperating.replace(link_range=0.5)
    assert not any("link_range" in limit for limit in wide.guarantee_limits)
    assert "sensors.delay = 0.2" in wide.guarantee_limits  # the tracker's margin is no guarantee


# In the world.


@pytest.mark.parametrize("shared", [False, True])
def test_an_episode_continues_alike_from_its_state(shared):
    scenario = CROWD.replace(
        sensors={**FIELD, "odometry_noise": 0.1, "occlusion": 0.02, "field_of_view": 5.0}, safety_filter="announce",
        actuators={"disturbance": 0.01}, tracker={"enabled": True, "shared_motion": shared},
    )  # fmt: skip
    env = flocking_v0.parallel_env(scenario)
    env.reset(seed=1)
    actions = {agent: np.array([0.1, 0.5], np.float32) for agent in env.agents}
    for _ in range(7):
        env.step(actions)
    assert_copy_continues_alike(env, actions, 10)


def test_the_latest_estimate_is_part_of_the_state():
    scenario = CROWD.replace(sensors=FIELD, tracker={"enabled": True, "shared_motion": True})
    world, truth = begin(scenario)
    for _ in range(4):
        latest = world.sensors.measure(truth)
        truth, _ = world.step(np.full((1, 6, 2), 0.1))
    latest = world.sensors.measure(truth)
    other = World(scenario)
    other.load_state_dict(world.state_dict())
    for now, then in ((other.sensors.latest, latest), (other.sensors.latest.previous, latest.previous)):
        for ours, theirs in ((now.neighbors, then.neighbors), (now.obstacles, then.obstacles)):
            np.testing.assert_array_equal(ours.positions, theirs.positions)
            np.testing.assert_array_equal(ours.stds, theirs.stds)
        np.testing.assert_array_equal(now.unplaced, then.unplaced)


@pytest.mark.parametrize("shared", [False, True])
def test_a_flocks_estimates_do_not_depend_on_the_batch(shared):
    scenario = CROWD.replace(
        sensors={**FIELD, "odometry_noise": 0.1, "field_of_view": 4.0}, safety_filter="announce", max_cycles=20,
        tracker={"enabled": True, "shared_motion": shared},
    )  # fmt: skip
    many, few = (rollout(make_controller("orca"), scenario, 6, 0, batch) for batch in (6, 2))
    for name in many:
        np.testing.assert_array_equal(many[name], few[name])


@pytest.mark.parametrize("shared", [False, True])
def test_randomized_flocks_are_tracked_as_alone(shared):
    """With delay, noise and dropout of its own, each flock has the estimates that it would have alone."""
    ranges = {"sensors.delay": (0.0, 0.3), "sensors.position_noise": (0.0, 0.02), "sensors.dropout": (0.0, 0.3)}
    scenario = CROWD.replace(tracker={"enabled": True, "shared_motion": shared})
    together = World(scenario, 5, randomization=ranges)
    truth = together.reset([episode_rng(0, episode) for episode in range(5)])
    alone = [World(scenario, 1, randomization=ranges) for _ in range(5)]
    truths = [world.reset([episode_rng(0, episode)]) for episode, world in enumerate(alone)]
    for _ in range(12):
        estimate = together.sensors.measure(truth)
        own = [world.sensors.measure(each) for world, each in zip(alone, truths, strict=True)]
        for name in ("neighbors", "obstacles"):
            parts = [getattr(each, name) for each in own]
            np.testing.assert_allclose(
                getattr(estimate, name).positions, np.concatenate([part.positions for part in parts]), atol=1e-14
            )
        truth, _ = together.step(np.full((5, 6, 2), 0.1))
        truths = [world.step(np.full((1, 6, 2), 0.1))[0] for world in alone]
    assert len(set(np.rint(together.drawn["sensors.delay"] / STEP))) > 1


@pytest.mark.parametrize("seed", [0, 1])
def test_with_errors_the_filter_violates_less_with_a_tracker(seed):
    task = Scenario(
        n_vehicles=5, n_obstacles=2, arena=0.4, safety_filter="announce", sensors=FIELD,
        actuators={"speed_lag": 0.1, "slip": 0.05}, max_cycles=60,
    )  # fmt: skip
    rates = [
        rollout(make_controller("olfati-saber"), task.replace(tracker=tracker), 30, seed)["neighbor_violation_rate"].mean()
        for tracker in ({}, {"enabled": True}, {"enabled": True, "shared_motion": True})
    ]
    assert rates[1] < 0.5 * rates[0]
    assert rates[2] < 0.2 * rates[0]


def test_a_wrong_setting_is_one_line():
    with pytest.raises(SettingsError, match=r"tracker\.gate = 0: input should be greater"):
        Scenario(tracker={"gate": 0})
