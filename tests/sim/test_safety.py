"""No vehicle violates a separation through its own motion: random and adversarial drivers; ``-m slow`` takes 10^7 steps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.controllers import make_controller
from sb3_flock.envs import flocking_v0
from sb3_flock.evaluation import evaluate
from sb3_flock.serialization.yaml_io import load_config, parse_overrides
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng, safety
from sb3_flock.sim.actuators import follow
from sb3_flock.sim.dynamics import Stopping
from sb3_flock.sim.randomization import UNBOUNDED
from sb3_flock.sim.safety import filter_actions, reserve_stopping
from sb3_flock.sim.sensing import nearest
from tests.helpers import assert_copy_continues_alike, place

FILTERS = ["voronoi", "motion", "heading", "announce"]
LAG = 0.2


def filtered(safety_filter, **fields):
    """A scenario with a filter."""
    return Scenario(safety_filter=safety_filter, motion_lag=LAG, **fields)


def speeds_after(scenario, positions, headings, **bodies):
    """The executed speeds of vehicles that all ask for top speed."""
    world = place(scenario, positions, headings, **bodies)
    _, executed = world.step(np.full((1, len(positions), 2), (scenario.max_speed, 0.0)))
    return executed[0, :, 0]


def test_without_a_filter_the_clipped_actions_are_executed_to_the_last_bit(scenario):
    assert (scenario.safety_filter, scenario.obstacle_filter) == ("off", False)
    actions = np.random.default_rng(0).normal(size=(1, 2, 2))
    world = place(scenario, [(0.0, 0.0), (0.1, 0.0)], [0.0, np.pi])
    executed = world.step(actions)[1]
    np.testing.assert_array_equal(executed, np.clip(actions, world.action_low, world.action_high))


@pytest.mark.parametrize("safety_filter", FILTERS)
def test_two_vehicles_that_head_for_each_other_share_the_gap(safety_filter):
    speeds = speeds_after(filtered(safety_filter), [(0.0, 0.0), (0.12, 0.0)], [0.0, np.pi])
    np.testing.assert_allclose(speeds, 0.1, rtol=1e-6)  # 0.01 m of the gap of 0.02 m in 0.1 s


@pytest.mark.parametrize(
    ("safety_filter", "speed"), [("voronoi", 0.05), ("motion", 0.05), ("heading", 0.1), ("announce", 0.15)]
)
def test_a_follower_may_use_what_it_knows_of_the_vehicle_ahead(safety_filter, speed):
    """What it knows of a motion that has just begun is nothing."""
    speeds = speeds_after(filtered(safety_filter), [(0.0, 0.0), (0.11, 0.0)], [0.0, 0.0])
    np.testing.assert_allclose(speeds, [speed, 0.15], rtol=1e-6)


def test_a_follower_knows_no_speed_that_the_vehicle_ahead_does_not_reach():
    """The third vehicle stands in the way of the second: what the second announces is its bounded speed."""
    speeds = speeds_after(filtered("announce"), [(0.0, 0.0), (0.101, 0.0), (0.203, 0.0)], [0.0, 0.0, np.pi])
    np.testing.assert_allclose(speeds, [0.02, 0.01, 0.01], rtol=1e-6)


@pytest.mark.parametrize(("turned", "speed"), [(0.0, 0.1), (0.9, 0.1), (1.0, 0.05)])
def test_the_motion_over_the_lag_tells_that_a_neighbor_heads_away(turned, speed):
    """A neighbor can turn by 0.63 rad in 0.2 s: a motion of 1 rad off the line may have become an approach."""
    world = place(filtered("motion"), [(0.0, 0.0), (0.11, 0.0)], [0.0, turned])
    sensing = world.sense()
    for asked in (0.0, 0.0, 0.15):
        world.sensors.measure(sensing)
        sensing, executed = world.step([[(asked, 0.0), (0.001, 0.0)]])
    assert executed[0, 0, 0] == pytest.approx(speed, rel=0.05)


def test_a_vehicle_that_touches_its_bound_may_recede_but_not_slide():
    scenario = filtered("voronoi", max_speed=0.1)
    positions = [(0.0, 0.0), (scenario.neighbor_separation, 0.0)]
    np.testing.assert_array_equal(speeds_after(scenario, positions, [np.pi / 2, 0.0]), [0.0, 0.1])


def test_a_margin_is_kept_beyond_the_separation():
    speeds = speeds_after(filtered("voronoi", safety_margin=0.01), [(0.0, 0.0), (0.12, 0.0)], [0.0, np.pi])
    np.testing.assert_allclose(speeds, 0.05, rtol=1e-6)


def test_turn_rates_are_not_changed():
    world = place(filtered("heading"), [(0.0, 0.0), (0.1, 0.0)], [0.0, np.pi])
    np.testing.assert_array_equal(world.step([[(0.1, 1.0), (0.1, -2.0)]])[1], [[(0.0, 1.0), (0.0, -2.0)]])


def test_the_obstacle_filter_leaves_the_worst_obstacle_its_part_of_the_gap():
    scenario = Scenario(obstacle_filter=True)
    near = speeds_after(scenario, [(0.0, 0.0)], [0.0], obstacles=[(0.165, 0.0)])  # 0.01 m of the gap are the obstacle's
    np.testing.assert_allclose(near, 0.05, rtol=1e-6)
    away = speeds_after(scenario, [(0.0, 0.0)], [np.pi], obstacles=[(0.151, 0.0)])
    np.testing.assert_array_equal(away, 0.15)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"safety_filter": "voronoi", "link_range": 0.12},
            r"link_range = 0.12: safety_filter needs more than .* = 0.1 \+ 0.03",
        ),
        ({"safety_filter": "heading", "safety_margin": 0.03}, r"link_range = 0.15: safety_filter .* = 0.13 \+ 0.03"),
        ({"obstacle_filter": True, "detection_range": 0.17}, r"detection_range = 0.17: obstacle_filter .* = 0.15 \+ 0.025"),
        ({"safety_filter": "motion"}, "safety_filter = motion: motion_lag > 0 is needed"),
        ({"safety_filter": "on"}, "safety_filter = 'on'"),
    ],
)
def test_settings_that_cannot_hold_are_one_line(fields, message):
    with pytest.raises(SettingsError, match=message):
        Scenario(**fields)


def test_off_may_be_written_without_quotes():
    """YAML reads it as false."""
    overrides = parse_overrides(["safety_filter=off"])
    assert load_config(Scenario, overrides=overrides, base=Scenario(safety_filter="voronoi")).safety_filter == "off"


def test_sensing_that_reaches_just_far_enough_is_accepted():
    Scenario(safety_filter="voronoi", link_range=0.1300001)


def test_the_levels_with_headings_need_headings():
    world = place(Scenario(), [(0.0, 0.0)], [0.0])
    with pytest.raises(ValueError, match="frames = None: safety_filter = heading"):
        filter_actions(np.zeros((1, 1, 2)), world.sense(), Scenario(safety_filter="heading"))


def test_the_filter_uses_what_the_vehicles_measure():
    """A vehicle that detects nothing is not slowed."""
    scenario = Scenario(safety_filter="voronoi", sensors={"dropout": 1.0})
    world = place(scenario, [(0.0, 0.0), (0.11, 0.0)], [0.0, np.pi])
    world.sensors.measure(world.sense())
    assert (world.step(np.full((1, 2, 2), (0.15, 0.0)))[1][..., 0] == 0.15).all()


@pytest.mark.parametrize("safety_filter", FILTERS)
@pytest.mark.parametrize("errors", [{}, {"position_noise": 0.01, "dropout": 0.1, "delay": 0.2}])
def test_an_episode_restored_from_its_state_is_filtered_alike(safety_filter, errors):
    """The filter uses the last measurement, also right after the state was restored."""
    env = flocking_v0.parallel_env(filtered(safety_filter, n_vehicles=10, arena=0.3, obstacle_arena=1.0, sensors=errors))
    env.reset(seed=0)
    actions = dict.fromkeys(env.possible_agents, np.array([0.15, 0.5], np.float32))
    for _ in range(5):
        env.step(actions)
    assert_copy_continues_alike(env, actions, 20)


def test_the_reward_charges_the_executed_action():
    """Vehicles that are stopped have no penalty for the speed that they asked for."""
    env = flocking_v0.parallel_env(filtered("voronoi", n_vehicles=2))
    env.reset(seed=0)
    env.world.positions, env.world.headings = np.array([[(0.0, 0.0), (0.1, 0.0)]]), np.array([[0.0, -np.pi]])
    env.world.sensors.forget()
    infos = env.step(dict.fromkeys(env.agents, np.array([0.15, 0.0], np.float32)))[-1]
    assert [info["reward_terms"]["control"] for info in infos.values()] == [0.0, 0.0]


# Drivers that provoke violations: each maps a world and a generator to actions.


def rush(world, rng):
    """Everyone turns towards the waypoint at top speed."""
    x, y = np.moveaxis(world.sense().waypoint_positions, -1, 0)
    return np.stack((np.full_like(x, world.scenario.max_speed), np.arctan2(y, x) / world.scenario.time_step), axis=-1)


def chase(world, rng):
    """Everyone turns towards the nearest vehicle at top speed."""
    offsets = world.positions[:, None] - world.positions[:, :, None]
    distances = np.linalg.norm(offsets, axis=-1)
    distances[:, range(distances.shape[1]), range(distances.shape[1])] = np.inf
    target = np.take_along_axis(offsets, distances.argmin(-1)[..., None, None], axis=2)[:, :, 0]
    turns = np.arctan2(target[..., 1], target[..., 0]) - world.headings
    turns = (turns + np.pi) % (2 * np.pi) - np.pi
    return np.stack((np.full_like(turns, world.scenario.max_speed), turns / world.scenario.time_step), axis=-1)


def wander(world, rng):
    """Random actions, some out of bounds, some speeds tiny."""
    actions = rng.normal(size=(*world.positions.shape[:2], 2)) * (world.scenario.max_speed, world.scenario.max_turn_rate)
    actions[..., 0] *= 10 ** rng.uniform(-18, 1, actions.shape[:2])
    return actions


def stop_and_go(world, rng):
    """The crowd rushes, and each vehicle stands or flees now and then."""
    actions = rush(world, rng)
    luck = rng.random(actions.shape[:2])
    actions[..., 0] *= luck > 0.3
    actions[..., 1] *= np.where(luck > 0.8, -1.0, 1.0)
    return actions


DRIVERS = [rush, chase, wander, stop_and_go]


def pack(world, rng):
    """Put the vehicles of each flock on a square lattice as near to each other as numbers allow, with random headings."""
    flocks, vehicles, _ = world.positions.shape
    spacing = world.scenario.neighbor_separation * (1 + 1e-14)
    cells = np.stack(np.divmod(np.arange(vehicles), int(np.ceil(np.sqrt(vehicles)))), axis=-1)
    world.positions = spacing * (cells + rng.uniform(-1, 1, (flocks, 1, 2)))
    world.headings = rng.uniform(-np.pi, np.pi, (flocks, vehicles))
    world.sensors.forget()


def simulate(scenario, driver, n_flocks, seed, is_packed=False):
    """Simulate a driver; no violation may occur. The number of simulated vehicle-steps."""
    rng = np.random.default_rng(seed)
    world = World(scenario, n_flocks)
    sensing = world.reset([episode_rng(seed, episode) for episode in range(n_flocks)])
    if is_packed:
        pack(world, rng)
        sensing = world.sense()
    assert sensing.neighbors.count(scenario.neighbor_separation).sum() == 0
    for _ in range(scenario.max_cycles):
        world.sensors.measure(sensing)
        sensing, _ = world.step(driver(world, rng))
        assert sensing.neighbors.count(scenario.neighbor_separation).sum() == 0
    return n_flocks * scenario.n_vehicles * scenario.max_cycles


def random_task(rng, n_vehicles, safety_filter):
    """A crowded task of any size, from centimeters to kilometers."""
    unit, dt = 10 ** rng.uniform(-2, 3), 10 ** rng.uniform(-2, 0)
    separation, stride = unit * rng.uniform(0.5, 1), unit * 10 ** rng.uniform(-3, 0)
    return Scenario(
        n_vehicles=n_vehicles,
        n_obstacles=0,
        max_cycles=int(rng.integers(20, 100)),
        time_step=dt,
        motion_lag=dt * int(rng.integers(1, 4)),
        max_speed=stride / dt,
        max_turn_rate=10 ** rng.uniform(-1, 1) / dt,
        waypoint_speed=stride / dt * rng.uniform(0, 1),
        arena=separation * np.sqrt(n_vehicles) * rng.uniform(1.2, 3),
        neighbor_separation=separation,
        link_range=separation * rng.uniform(1.001, 1.5) + 2 * stride,
        safety_filter=safety_filter,
    )


def provoke(vehicle_steps, seed):
    """Random tasks of 2 to 200 vehicles with each driver and filter, until so many vehicle-steps are simulated."""
    rng = np.random.default_rng(seed)
    simulated = 0
    while simulated < vehicle_steps:
        n_vehicles = int(rng.integers(2, 1 + 200 ** rng.uniform(0.2, 1)))
        task = random_task(rng, n_vehicles, str(rng.choice(FILTERS)))
        driver = DRIVERS[rng.integers(len(DRIVERS))]
        simulated += simulate(task, driver, max(1, 200 // n_vehicles), int(rng.integers(2**31)), bool(rng.random() < 0.5))
    return simulated


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 40), st.sampled_from(FILTERS), st.sampled_from(DRIVERS), st.booleans())
def test_a_view_of_half_the_circle_keeps_the_guarantee(seed, n_vehicles, safety_filter, driver, is_packed):
    """A vehicle never moves backwards, and a neighbor that sees it from behind knows no more of it than it may use."""
    scenario = random_task(np.random.default_rng(seed), n_vehicles, safety_filter).replace(sensors={"field_of_view": np.pi})
    assert scenario.guarantee_limits == ()
    simulate(scenario, driver, 2, seed, is_packed)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 40), st.sampled_from(FILTERS), st.sampled_from(DRIVERS), st.booleans())
def test_no_pair_ends_a_step_nearer_than_its_separation(seed, n_vehicles, safety_filter, driver, is_packed):
    rng = np.random.default_rng(seed)
    simulate(random_task(rng, n_vehicles, safety_filter), driver, 2, seed, is_packed)


@pytest.mark.parametrize("safety_filter", FILTERS)
@pytest.mark.parametrize("driver", DRIVERS)
def test_vehicles_that_start_too_near_come_no_nearer(driver, safety_filter):
    scenario = filtered(safety_filter, n_vehicles=20, n_obstacles=0)
    rng, world = np.random.default_rng(0), World(scenario, 5)
    world.reset([episode_rng(3, episode) for episode in range(5)])
    world.positions = world.positions * 0.2
    sensing, apart = world.sense(), None
    for _ in range(50):
        world.sensors.measure(sensing)
        before, apart = apart, np.linalg.norm(world.positions[:, None] - world.positions[:, :, None], axis=-1)
        if before is not None:
            assert (apart >= np.minimum(before, scenario.neighbor_separation)).all()
        sensing, _ = world.step(driver(world, rng))


@pytest.mark.parametrize("safety_filter", ["off", "announce"])
@pytest.mark.parametrize("driver", DRIVERS)
def test_no_vehicle_violates_the_separation_to_a_standing_obstacle(driver, safety_filter):
    scenario = Scenario(
        n_vehicles=8, n_obstacles=6, safety_filter=safety_filter, obstacle_filter=True, obstacle_max_speed=0.0
    )
    rng, world = np.random.default_rng(0), World(scenario, 20)
    world.reset([episode_rng(3, episode) for episode in range(20)])
    world.waypoints = world.obstacle_positions[:, 0].copy()  # the flock is sent into an obstacle
    for _ in range(scenario.max_cycles):
        sensing, _ = world.step(driver(world, rng))
        assert sensing.obstacles.count(scenario.obstacle_separation).sum() == 0
    assert nearest(world.positions, world.obstacle_positions).min() < 0.16


@pytest.mark.parametrize("driver", DRIVERS)
def test_only_an_obstacle_that_comes_near_of_its_own_violates_a_separation(driver):
    """A violation begins only where the obstacle's own stride sufficed for it, and it grows by no more than that."""
    scenario = Scenario(n_vehicles=8, n_obstacles=6, safety_filter="announce", obstacle_filter=True, obstacle_arena=0.5)
    rng, world = np.random.default_rng(0), World(scenario, 50)
    world.reset([episode_rng(3, episode) for episode in range(50)])
    begun = 0
    for _ in range(scenario.max_cycles):
        before, places = world.positions, world.obstacle_positions
        world.step(driver(world, rng))
        strides = np.linalg.norm(world.obstacle_positions - places, axis=-1)[:, None]
        apart, after = (
            np.linalg.norm(bodies[:, None] - positions[:, :, None], axis=-1)
            for bodies, positions in ((places, before), (world.obstacle_positions, world.positions))
        )
        violated = after < scenario.obstacle_separation
        assert (after >= apart - strides - 1e-12)[violated].all()
        begun += (violated & (apart >= scenario.obstacle_separation)).sum()
    assert begun > 0


# Vehicles that do not stop at once.


def test_what_ends_the_guarantee_is_named():
    assert Scenario().guarantee_limits == ()
    assert Scenario(actuators={"slip": 0.1}).guarantee_limits == ()  # nothing was guaranteed
    exact = filtered("announce", actuators={"turn_lag": 0.2, "max_turn_acceleration": 3.0})
    assert exact.guarantee_limits == ()
    other = filtered("announce", actuators={"speed_lag": 0.1, "min_speed": 0.05}, sensors={"position_noise": 0.01})
    assert other.guarantee_limits == (
        "actuators.speed_lag = 0.1",
        "actuators.min_speed = 0.05",
        "sensors.position_noise = 0.01",
        "link_range = 0.15, of which two vehicles need 0.16 to stop",
    )
    assert filtered("voronoi", sensors={"field_of_view": 3.0}).guarantee_limits == ("sensors.field_of_view = 3",)
    assert filtered("voronoi", sensors={"odometry_noise": 0.1}).guarantee_limits == ()
    assert filtered("motion", sensors={"odometry_noise": 0.1}).guarantee_limits == ("sensors.odometry_noise = 0.1",)
    assert Scenario(obstacle_filter=True, actuators={"disturbance": 0.01}).guarantee_limits == (
        "actuators.disturbance = 0.01",
    )


def test_an_evaluation_warns_in_one_line_of_a_filter_without_its_guarantee():
    controller, scenario = make_controller("go-to-waypoint"), filtered("voronoi", max_cycles=2)
    evaluate(controller, scenario, 1)
    with pytest.warns(UserWarning, match=r"^the safety filter guarantees no separation with actuators.slip = 0.1$"):
        evaluate(controller, scenario.replace(actuators={"slip": 0.1}), 1)


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 0.5), st.floats(0.05, 3) | st.just(None), st.floats(0.02, 0.3), st.floats(0.01, 0.5))
def test_a_vehicle_that_heads_for_a_standing_obstacle_stops_in_time_whatever_it_needs_for_it(lag, bound, dt, start):
    """Straight on, the way that is kept free is enough: up to rounding the vehicle ends at the separation."""
    actuators = {"speed_lag": lag, "max_acceleration": bound}
    ranges = {"obstacle_separation": 0.15, "detection_range": 2.0, "max_speed": 0.3, "obstacle_max_speed": 0.0}
    scenario = Scenario(obstacle_filter=True, time_step=dt, actuators=actuators, max_cycles=1000, **ranges)
    world = place(scenario, [(-start - 0.15, 0.0)], [0.0], obstacles=[(0.0, 0.0)])
    for _ in range(int(start / (0.3 * dt)) + 200):
        sensing, _ = world.step([[(0.3, 0.0)]])
        assert sensing.obstacles.distances[0] >= 0.15


def test_without_the_reserve_such_a_vehicle_violates_the_separation(monkeypatch):
    scenario = Scenario(obstacle_filter=True, obstacle_max_speed=0.0, actuators={"max_acceleration": 0.1})
    world = place(scenario, [(-0.5, 0.0)], [0.0], obstacles=[(0.0, 0.0)])
    monkeypatch.setattr(type(world.dynamics), "stopping", lambda self: None)
    nearest_distance = min(np.hypot(*world.step([[(0.15, 0.0)]])[0].obstacles.positions.T).min(initial=1) for _ in range(80))
    assert nearest_distance < 0.1


@settings(max_examples=300, deadline=None)
@given(
    st.floats(0, 1),
    st.floats(0, 1),
    st.floats(0, 1),
    st.floats(0.01, 10) | st.just(UNBOUNDED),
    st.floats(0.01, 1),
    st.floats(0, 0.5),
)
def test_the_admitted_command_is_followed_by_a_stop_within_the_budget(asked, speed, lag, bound, dt, budget):
    """The way of a step with the highest command that the rows admit, and of a full stop after it, fits the budget."""
    stopping = Stopping(*(np.full((1, 1), value) for value in (speed, lag, bound)))
    contact = np.zeros(1, np.int64), np.array([dt]), np.array([budget])
    observers, strides, budgets = reserve_stopping(*contact, stopping, dt)
    command = min(asked, (budgets / strides).min())
    after, way = follow(*map(np.float64, (speed, command, lag, bound)), dt)
    reach = speed
    for _ in range(400):  # the stop, from each of the two speeds
        after, stride = follow(after, np.float64(0.0), np.float64(lag), np.float64(bound), max(dt, 0.3))
        way += stride
    needed = 0.0
    for _ in range(400):
        reach, stride = follow(np.float64(reach), np.float64(0.0), np.float64(lag), np.float64(bound), max(dt, 0.3))
        needed += stride
    assert way <= max(budget, needed) + 1e-9  # no command helps where already the stop takes more than there is
    assert list(observers) == [0, 0]


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("use_numba", [True, False])
def test_ten_million_vehicle_steps_without_a_violation(use_numba, monkeypatch):
    if not use_numba:
        monkeypatch.setattr(safety, "compiled", lambda module: None)
    assert provoke(10_000_000, seed=int(use_numba)) >= 10_000_000


def test_a_world_without_numba_steps_alike(monkeypatch):
    def states():
        world = World(filtered("announce", n_vehicles=20, obstacle_filter=True), 3)
        world.reset([episode_rng(0, episode) for episode in range(3)])
        return [world.step(rush(world, None))[1] for _ in range(100)]

    fast = states()
    monkeypatch.setattr(safety, "compiled", lambda module: None)
    np.testing.assert_array_equal(fast, states())


def test_the_reserve_is_the_same_without_numba(monkeypatch):
    scenario = filtered(
        "announce", n_vehicles=20, obstacle_filter=True, actuators={"speed_lag": 0.1, "max_acceleration": 1.0}
    )

    def states():
        world = World(scenario, 3)
        world.reset([episode_rng(0, episode) for episode in range(3)])
        return [world.step(rush(world, None))[1] for _ in range(60)]

    fast = states()
    monkeypatch.setattr(safety, "compiled", lambda module: None)
    np.testing.assert_array_equal(fast, states())


def test_a_reserve_lowers_speeds_and_never_below_zero():
    """Beside the same filter without it, from the same state."""
    scenario = filtered("announce", n_vehicles=20, actuators={"speed_lag": 0.2}, obstacle_filter=True)
    world = World(scenario, 3)
    world.reset([episode_rng(0, episode) for episode in range(3)])
    lowered = 0
    for _ in range(60):
        actions = np.clip(rush(world, None), world.action_low, world.action_high)
        measured, stopping = world.sense(), world.dynamics.stopping()
        kept = filter_actions(actions, measured, scenario, world.frames, stopping=stopping)
        plain = filter_actions(actions, measured, scenario, world.frames)
        assert (kept[..., 0] >= 0).all()
        assert (kept[..., 0] <= plain[..., 0] + 1e-12).all()
        lowered += (kept[..., 0] < plain[..., 0] - 1e-6).sum()
        world.step(actions)
    assert lowered > 100
