import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import Scenario, mix_rewards, own_reward, reward_terms, sense
from tests.helpers import place

WEIGHTS = {
    "epsilon": 0.5,
    "beta": -0.01,
    "link_bonus": 1.0,
    "separation_penalty": 1.0,
    "obstacle_penalty": 1.0,
    "scale": 1.0,
}
PAPER = Scenario(reward=WEIGHTS)


def test_the_four_terms_by_hand():
    # 0 is linked to 1 (0.12), too close to 2 (0.05), too close to one obstacle (0.1) and merely sees the other (0.2).
    world = place(
        PAPER, [(0.0, 0.0), (0.12, 0.0), (-0.05, 0.0)], [0.0] * 3, obstacles=[(0.0, 0.1), (0.0, -0.2)], waypoint=(0.3, 0.4)
    )
    actions = np.array([[(0.1, 2.0), (0.0, 0.0), (0.15, -1.0)]])
    terms = {name: term[0] for name, term in reward_terms(sense(world), actions, world.scenario).items()}
    np.testing.assert_allclose(terms["connectivity"], [1 - 1, 1, -1])
    np.testing.assert_allclose(terms["obstacle"], [-1, 0, -1])
    np.testing.assert_allclose(terms["waypoint"][0], -0.25)
    np.testing.assert_allclose(terms["control"], [-0.01 * (0.01 + 4), 0.0, -0.01 * (0.0225 + 1)])
    np.testing.assert_allclose(own_reward(terms)[0], 0 - 1 - 0.25 - 0.0401)


def test_thresholds_are_strict():
    exact = PAPER.replace(neighbor_separation=0.125, link_range=0.25, obstacle_separation=0.25, detection_range=0.5)
    world = place(exact, [(0.0, 0.0), (0.125, 0.0), (-0.25, 0.0)], [0.0] * 3, obstacles=[(0.0, 0.25)])
    terms = reward_terms(sense(world), np.zeros((1, 3, 2)), world.scenario)
    assert terms["connectivity"][0].tolist() == [1.0, 1.0, 0.0]  # 0.125 is not too close, 0.25 is not linked
    assert terms["obstacle"][0, 0] == 0.0


def test_weights_and_scale_multiply_their_terms():
    scenario = PAPER.replace(
        reward=PAPER.reward.replace(separation_penalty=3.0, obstacle_penalty=2.0, link_bonus=0.5, scale=0.1)
    )
    world = place(scenario, [(0.0, 0.0), (0.12, 0.0), (-0.05, 0.0)], [0.0] * 3, obstacles=[(0.0, 0.1)], waypoint=(1.0, 0.0))
    terms = reward_terms(sense(world), np.zeros((1, 3, 2)), world.scenario)
    np.testing.assert_allclose(terms["connectivity"][0, 0], 0.1 * (0.5 - 3.0))
    np.testing.assert_allclose(terms["obstacle"][0, 0], -0.2)
    np.testing.assert_allclose(terms["waypoint"][0, 0], -0.05)


def test_beyond_the_largest_distance_the_waypoint_costs_no_more():
    near = PAPER.replace(reward=PAPER.reward.replace(max_distance=0.3))
    world = place(near, [(0.0, 0.0), (0.8, 0.0)], [0.0] * 2, waypoint=(1.0, 0.0))
    terms = reward_terms(sense(world), np.zeros((1, 2, 2)), world.scenario)
    np.testing.assert_allclose(terms["waypoint"][0], [-0.15, -0.1])


def test_the_mix_by_hand():
    observers, neighbors = np.array([(0, 1), (0, 2), (1, 0), (2, 0)]).T
    mixed = mix_rewards(np.array([1.0, 2.0, 4.0]), observers, neighbors, 0.7)
    np.testing.assert_allclose(mixed, [0.7 * 1 + 0.3 * 3, 0.7 * 2 + 0.3 * 1, 0.7 * 4 + 0.3 * 1])


def test_a_vehicle_without_neighbors_keeps_its_own_reward_unscaled():
    none = np.zeros(0, dtype=np.int64)
    np.testing.assert_array_equal(mix_rewards(np.array([[-2.0, 3.0]]), none, none, 0.7), [[-2.0, 3.0]])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 1))
def test_the_mix_is_the_mean_over_the_graph_and_stays_between_the_rewards(seed, lambda_):
    rng = np.random.default_rng(seed)
    rewards, linked = rng.normal(size=(3, 5)), rng.random((3, 5, 5)) < 0.4
    flocks, i, j = np.nonzero(linked)
    mixed = mix_rewards(rewards, 5 * flocks + i, 5 * flocks + j, lambda_)
    assert (mixed <= rewards.max(-1, keepdims=True) + 1e-12).all()
    assert (mixed >= rewards.min(-1, keepdims=True) - 1e-12).all()
    for flock, vehicle in np.ndindex(3, 5):
        own, others = rewards[flock, vehicle], rewards[flock, linked[flock, vehicle]]
        expected = lambda_ * own + (1 - lambda_) * others.mean() if len(others) else own
        assert mixed[flock, vehicle] == pytest.approx(expected)


@pytest.mark.parametrize(("lambda_", "expected"), [(0.0, [5.0, 1.0]), (1.0, [1.0, 5.0])])
def test_the_ends_of_lambda(lambda_, expected):
    np.testing.assert_allclose(mix_rewards(np.array([1.0, 5.0]), np.array([0, 1]), np.array([1, 0]), lambda_), expected)
