import numpy as np
import pytest

from sb3_flock.sim import Scenario, World
from sb3_flock.sim.safety import filter_actions

kernels = pytest.importorskip("sb3_flock.controllers.mpc_kernels")

PARAMS = kernels.CostParams(0.11, 0.16, 0.12, 0.1, 500.0, 1000.0, 60.0)
UNFILTERED = kernels.FilterParams(0.1, 0, False)


def cost(positions, waypoint, obstacles, params):
    """The cost of one step, which :func:`cost_gradient` is the gradient of, in plain NumPy."""
    between = np.linalg.norm(positions[:, None] - positions, axis=-1)
    pairs = between[np.triu_indices(len(positions), 1)]
    clearances = np.linalg.norm(positions[:, None] - obstacles, axis=-1)
    inside, links = {0}, 0.0
    while len(inside) < len(positions):  # the minimum spanning tree, by its next shortest link
        link, new = min((between[i, j], j) for i in inside for j in range(len(positions)) if j not in inside)
        inside.add(new)
        excess = min(max(0.0, link - params.max_link_length), params.link_cutoff)
        links += excess**2 / 2 - 2 * excess**3 / (3 * params.link_cutoff) + excess**4 / (4 * params.link_cutoff**2)
    return (
        np.sqrt(((positions - waypoint) ** 2).sum(-1) + 0.02**2).mean()
        + params.separation_weight / 2 * (np.maximum(0.0, params.separation - pairs) ** 2).sum()
        + params.clearance_weight / 2 * (np.maximum(0.0, params.clearance - clearances) ** 2).sum()
        + params.link_weight * links
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_gradient_is_that_of_the_cost(seed):
    rng = np.random.default_rng(seed)
    positions, obstacles, waypoint = (
        rng.uniform(-size, size, (count, 2)) for size, count in ((0.12, 5), (0.3, 2), (0.05, 1))
    )
    gradient, numeric = np.empty((5, 2)), np.empty((5, 2))
    kernels.cost_gradient(gradient, positions, waypoint[0], obstacles, PARAMS)
    for i, axis in np.ndindex(5, 2):
        nudge = np.zeros((5, 2))
        nudge[i, axis] = 1e-6
        higher, lower = (cost(positions + sign * nudge, waypoint, obstacles, PARAMS) for sign in (1, -1))
        numeric[i, axis] = (higher - lower) / 2e-6
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-5)


def simulate(plan, positions, headings, max_step, max_turn):
    """The unicycles' positions after each step of a plan, ``(horizon, vehicles, 2)``."""
    positions, headings, trajectory = positions.copy(), headings.copy(), []
    for step in range(plan.shape[1]):
        directions = np.stack((np.cos(headings), np.sin(headings)), axis=-1)
        positions = positions + plan[:, step, :1] * max_step * directions
        headings = headings + plan[:, step, 1] * max_turn
        trajectory.append(positions)
    return np.array(trajectory)


@pytest.mark.parametrize("seed", range(5))
def test_an_optimized_plan_is_within_the_bounds_and_costs_less(seed):
    rng, horizon = np.random.default_rng(seed), 12
    positions, headings = rng.uniform(-0.2, 0.2, (4, 2)), rng.uniform(-np.pi, np.pi, 4)
    waypoints, obstacles = np.full((horizon, 2), 0.1), np.tile(rng.uniform(-0.3, 0.3, (1, 2, 2)), (horizon, 1, 1))
    bounds = 0.015, np.pi / 10

    def total(plan):
        trajectory = simulate(plan, positions, headings, *bounds)
        return sum(cost(trajectory[t], waypoints[t], obstacles[t], PARAMS) for t in range(horizon))

    costs = [total(np.zeros((4, horizon, 2)))]
    for n_iterations in (30, 200):
        plan = np.zeros((4, horizon, 2))
        kernels.optimize(plan, positions, headings, waypoints, obstacles, *bounds, PARAMS, UNFILTERED, n_iterations, 0.06)
        assert plan[..., 0].min() >= 0.0
        assert plan[..., 1].min() >= -1.0
        assert plan.max() <= 1.0
        costs.append(total(plan))
    assert costs[0] > costs[1] > costs[2]


LEVELS = {
    "voronoi": kernels.FilterParams(0.1, 1, False),
    "heading": kernels.FilterParams(0.1, 1, True),
    "announce": kernels.FilterParams(0.1, 2, True),
}


def crowd(seed, n=6):
    """Vehicles near each other, none nearer than the separation, with headings and the strides that they ask for."""
    rng, placed = np.random.default_rng(seed), []
    while len(placed) < n:
        point = rng.uniform(-0.15, 0.15, 2)
        if all(np.hypot(*(point - other)) > 0.1 for other in placed):
            placed.append(point)
    return np.array(placed), rng.uniform(-np.pi, np.pi, n), rng.uniform(0.0, 0.015, n)


def limited(positions, headings, asked, safety):
    """The strides that the filter admits, by whom each vehicle is held, and how its stride grows with that neighbor's state."""
    strides, held_by, slack = asked.copy(), np.empty(len(asked), np.int64), np.zeros((len(asked), 2))
    kernels.limit_strides(strides, held_by, slack, positions, np.cos(headings), np.sin(headings), 0.015, safety)
    return strides, held_by, slack


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("seed", range(20))
def test_the_strides_of_a_plan_are_those_of_the_worlds_filter(level, seed):
    positions, headings, asked = crowd(seed)
    scenario = Scenario(n_vehicles=6, n_obstacles=0, safety_filter=level)
    world = World(scenario)
    world.reset([np.random.default_rng(0)])
    world.positions, world.headings = positions[None], headings[None]
    actions = np.stack((asked / scenario.time_step, np.zeros(6)), axis=-1)[None]
    expected = filter_actions(actions, world.sense(), scenario, world.frames)[0, :, 0] * scenario.time_step
    strides, held_by, _ = limited(positions, headings, asked, LEVELS[level])
    np.testing.assert_allclose(strides, expected, atol=1e-9)
    np.testing.assert_array_equal(held_by >= 0, strides < asked)


def test_some_vehicles_of_these_crowds_are_held():
    held = [limited(*crowd(seed), LEVELS["announce"])[1] >= 0 for seed in range(20)]
    assert 0.1 < np.mean(held) < 0.9


def test_a_plan_without_a_filter_is_not_limited():
    strides, held_by, _ = limited(*crowd(0), kernels.FilterParams(0.1, 0, True))
    np.testing.assert_array_equal(strides, crowd(0)[2])
    assert (held_by == -1).all()


@pytest.mark.parametrize("seed", range(20))
def test_a_held_vehicles_stride_grows_with_the_distance_of_who_holds_it(seed):
    positions, headings, asked = crowd(seed)
    strides, held_by, slack = limited(positions, headings, asked, LEVELS["heading"])
    for i in np.flatnonzero((held_by >= 0) & (strides > 0)):
        size, offset = 1e-7, positions[held_by[i]] - positions[i]
        distance = np.hypot(*offset)
        moved = positions.copy()
        moved[held_by[i]] += size * offset / distance  # along the line between them: the angles stay as they are
        further = limited(moved, headings, asked, LEVELS["heading"])[0][i]
        assert (further - strides[i]) / size == pytest.approx(slack[i, 0], rel=1e-3)


def test_a_held_vehicles_stride_grows_with_the_announced_one():
    """A follower close behind a vehicle that drives away: its bound is the gap and the leader's announced stride."""
    positions, headings = np.array([[0.0, 0.0], [0.103, 0.0]]), np.zeros(2)
    slow, fast = (limited(positions, headings, np.array([0.015, lead]), LEVELS["announce"]) for lead in (0.005, 0.006))
    assert slow[0][0] == pytest.approx(0.003 + 0.005)
    assert slow[1][0] == 1
    assert fast[0][0] - slow[0][0] == pytest.approx(0.001 * slow[2][0, 1])


def test_vehicles_in_the_way_of_one_that_flees_make_way():
    """Three vehicles in a row at their separation, an obstacle behind the last: all of them drive on at once."""
    positions, headings, horizon = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]), np.zeros(3), 10
    waypoints, obstacles = np.full((horizon, 2), 0.1), np.full((horizon, 1, 2), -0.13)
    obstacles[..., 1] = 0.0
    plans = []
    for weight in (0.0, 1000.0):
        plan = np.zeros((3, horizon, 2))
        params = PARAMS._replace(clearance_weight=weight, separation_weight=0.0, link_weight=0.0)
        kernels.optimize(
            plan, positions, headings, waypoints, obstacles, 0.015, np.pi / 10, params, LEVELS["announce"], 200, 0.06
        )
        plans.append(plan)
    assert plans[0][2, 0, 0] < 0.1  # the first of the row has passed the waypoint: it stands
    assert plans[1][2, 0, 0] > 0.5  # with the obstacle behind them it leaves, for the last to leave
