import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock import flocking_v0
from sb3_flock.serialization.yaml_io import load_config, to_yaml
from sb3_flock.settings import SettingsError
from sb3_flock.sim import RewardWeights, Scenario, mix_rewards, own_reward, register_reward_term, reward_terms
from sb3_flock.sim.reward import EXTRA_TERMS
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
    # 0 is linked to 1 (0.12), violates its separation to 2 (0.05) and to one obstacle (0.1), and detects the other (0.2).
    world = place(
        PAPER, [(0.0, 0.0), (0.12, 0.0), (-0.05, 0.0)], [0.0] * 3, obstacles=[(0.0, 0.1), (0.0, -0.2)], waypoint=(0.3, 0.4)
    )
    actions = np.array([[(0.1, 2.0), (0.0, 0.0), (0.15, -1.0)]])
    terms = {
        name: term[0] for name, term in reward_terms(world.sense(), actions, world.scenario.reward, world.scenario).items()
    }
    np.testing.assert_allclose(terms["connectivity"], [1 - 1, 1, -1])
    np.testing.assert_allclose(terms["obstacle"], [-1, 0, -1])
    np.testing.assert_allclose(terms["waypoint"][0], -0.25)
    np.testing.assert_allclose(terms["control"], [-0.01 * (0.01 + 4), 0.0, -0.01 * (0.0225 + 1)])
    np.testing.assert_allclose(own_reward(terms)[0], 0 - 1 - 0.25 - 0.0401)


def test_thresholds_are_strict():
    exact = PAPER.replace(neighbor_separation=0.125, link_range=0.25, obstacle_separation=0.25, detection_range=0.5)
    world = place(exact, [(0.0, 0.0), (0.125, 0.0), (-0.25, 0.0)], [0.0] * 3, obstacles=[(0.0, 0.25)])
    terms = reward_terms(world.sense(), np.zeros((1, 3, 2)), world.scenario.reward, world.scenario)
    assert terms["connectivity"][0].tolist() == [1.0, 1.0, 0.0]  # 0.125 is no violation, 0.25 is no link
    assert terms["obstacle"][0, 0] == 0.0


def test_weights_and_scale_multiply_their_terms():
    scenario = PAPER.replace(
        reward=PAPER.reward.replace(separation_penalty=3.0, obstacle_penalty=2.0, link_bonus=0.5, scale=0.1)
    )
    world = place(scenario, [(0.0, 0.0), (0.12, 0.0), (-0.05, 0.0)], [0.0] * 3, obstacles=[(0.0, 0.1)], waypoint=(1.0, 0.0))
    terms = reward_terms(world.sense(), np.zeros((1, 3, 2)), world.scenario.reward, world.scenario)
    np.testing.assert_allclose(terms["connectivity"][0, 0], 0.1 * (0.5 - 3.0))
    np.testing.assert_allclose(terms["obstacle"][0, 0], -0.2)
    np.testing.assert_allclose(terms["waypoint"][0, 0], -0.05)


def test_the_waypoint_penalty_saturates_at_the_maximum_distance():
    near = PAPER.replace(reward=PAPER.reward.replace(max_distance=0.3))
    world = place(near, [(0.0, 0.0), (0.8, 0.0)], [0.0] * 2, waypoint=(1.0, 0.0))
    terms = reward_terms(world.sense(), np.zeros((1, 2, 2)), world.scenario.reward, world.scenario)
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


# Terms registered outside the package


@pytest.fixture
def _extra_terms(restored):
    restored(EXTRA_TERMS)

    @register_reward_term("turning")
    def turning(sensing, actions, ranges):
        return np.abs(actions[..., 1])

    @register_reward_term("spacing")
    def spacing(sensing, actions, ranges):
        """How much of the link range the neighbors leave free."""
        return sensing.neighbors.sum(ranges.link_range - sensing.neighbors.distances)

    assert register_reward_term("turning")(turning) is turning  # the same function again is no error


@pytest.mark.usefixtures("_extra_terms")
def test_registered_terms_are_weighted_scaled_and_summed_with_the_others():
    weights = RewardWeights(**{**WEIGHTS, "scale": 0.5}, extra_terms={"spacing": 3.0, "turning": -2.0})
    world = place(PAPER, [(0.0, 0.0), (0.12, 0.0), (0.9, 0.0)], [0.0] * 3)
    actions = np.array([[(0.1, 2.0), (0.0, 0.0), (0.15, -1.0)]])
    terms = reward_terms(world.sense(), actions, weights, world.scenario)
    assert list(terms) == ["connectivity", "obstacle", "waypoint", "control", "spacing", "turning"]
    np.testing.assert_allclose(terms["turning"], [[-2.0, 0.0, -1.0]])
    np.testing.assert_allclose(terms["spacing"], [[0.045, 0.045, 0.0]])
    without = reward_terms(world.sense(), actions, weights.replace(extra_terms={}), world.scenario)
    np.testing.assert_allclose(own_reward(terms) - own_reward(without), terms["turning"] + terms["spacing"])


@pytest.mark.usefixtures("_extra_terms")
def test_a_registered_term_is_in_the_infos_and_the_reward_of_an_env():
    plain = flocking_v0.parallel_env(n_vehicles=4)
    env = flocking_v0.parallel_env(n_vehicles=4, reward=RewardWeights(extra_terms={"turning": -2.0}))
    plain.reset(seed=0)
    env.reset(seed=0)
    actions = {agent: np.array([0.1, i - 1.5], dtype=np.float32) for i, agent in enumerate(env.agents)}
    _, plain_rewards, *_ = plain.step(actions)
    _, rewards, *_, infos = env.step(actions)
    for i, agent in enumerate(env.agents):
        terms = infos[agent]["reward_terms"]
        assert list(terms) == ["connectivity", "obstacle", "waypoint", "control", "turning"]
        assert terms["turning"] == pytest.approx(env.scenario.reward.scale * -2.0 * abs(i - 1.5))
        assert rewards[agent] == pytest.approx(sum(terms.values()))
        assert rewards[agent] - plain_rewards[agent] == pytest.approx(terms["turning"])


@pytest.mark.usefixtures("_extra_terms")
def test_a_scenario_with_registered_terms_is_read_back(tmp_path):
    scenario = Scenario(reward=RewardWeights(extra_terms={"turning": -2.0, "spacing": 0.5}))
    assert Scenario(**scenario.model_dump()) == scenario
    assert Scenario(**scenario.model_dump(mode="json")).reward.extra_terms == {"turning": -2.0, "spacing": 0.5}
    (tmp_path / "scenario.yaml").write_text(to_yaml(scenario))
    assert load_config(Scenario, tmp_path / "scenario.yaml") == scenario


def test_a_term_that_is_not_registered_is_refused():
    with pytest.raises(SettingsError, match="extra_terms = turning: .*register_reward_term is needed; none is registered"):
        RewardWeights(extra_terms={"turning": 1.0})


@pytest.mark.usefixtures("_extra_terms")
def test_a_mistyped_term_is_refused_in_one_line_with_the_registered_ones():
    message = "extra_terms = turnin: .*; registered are turning, spacing; did you mean turning"
    with pytest.raises(SettingsError, match=message) as error:
        Scenario(reward={"extra_terms": {"turnin": 1.0}})
    assert "\n" not in str(error.value)
    with pytest.raises(SettingsError, match=r"extra_terms.turning = inf"):
        RewardWeights(extra_terms={"turning": float("inf")})


@pytest.mark.usefixtures("_extra_terms")
@pytest.mark.parametrize("name", ["turning", "waypoint"])
def test_a_terms_name_is_taken_once(name):
    with pytest.raises(ValueError, match=f"reward term '{name}' is registered already"):
        register_reward_term(name)(lambda sensing, actions, ranges: actions[..., 0])
