import numpy as np
import pytest

kernels = pytest.importorskip("sb3_flock.controllers.mpc_kernels")

PARAMS = kernels.CostParams(0.11, 0.16, 0.12, 0.1, 500.0, 1000.0, 60.0)


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
        kernels.optimize(plan, positions, headings, waypoints, obstacles, *bounds, PARAMS, n_iterations, 0.06)
        assert plan[..., 0].min() >= 0.0
        assert plan[..., 1].min() >= -1.0
        assert plan.max() <= 1.0
        costs.append(total(plan))
    assert costs[0] > costs[1] > costs[2]
