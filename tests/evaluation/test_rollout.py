import numpy as np
import pytest

from sb3_flock import FlockPolicy, Scenario, evaluate, render
from sb3_flock._renamed import RenamedWarning
from sb3_flock.controllers import Controller, make_controller
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.evaluation import METRICS, rollout
from sb3_flock.evaluation.metrics import EpisodeMetric
from sb3_flock.evaluation.rollout import as_controller, iter_rollout, rollout_batch
from sb3_flock.serialization.load import PolicyError, load_policy
from sb3_flock.settings import ActionError, SettingsError
from sb3_flock.sim import episode_rng

SCENARIO = Scenario(n_vehicles=5, n_obstacles=2, max_cycles=40, arena=0.5, obstacle_arena=0.5)


class GoToWaypoint(Controller):
    """Turns to the waypoint and drives to it, whatever else is sensed."""

    def act(self, sensing, scenario):
        x, y = sensing.waypoint_positions[..., 0], sensing.waypoint_positions[..., 1]
        return np.stack([np.maximum(x, 0.0) * 2, np.arctan2(y, x) * 5], axis=-1)


@pytest.fixture(scope="module")
def network():
    """Networks with large random weights, so that actions vary with the observations."""
    return FlockPolicy(observation_space(SCENARIO), action_space(SCENARIO), lr_schedule=lambda _: 0.0, final_init=1.0)


def test_the_numbers_do_not_depend_on_the_batch(network):
    results = [rollout(PolicyController(network), SCENARIO, 23, seed=4, batch=batch) for batch in (23, 10, 1)]
    for name in METRICS:
        np.testing.assert_array_equal(results[0][name], results[1][name])
        np.testing.assert_array_equal(results[0][name], results[2][name])


def test_fewer_episodes_are_the_first_of_more(network):
    many, few = (rollout(PolicyController(network), SCENARIO, episodes, seed=4) for episodes in (20, 5))
    np.testing.assert_array_equal(many["return"][:5], few["return"])


def test_seeds_change_the_episodes():
    first, second = (rollout(GoToWaypoint(), SCENARIO, 5, seed=seed)["return"] for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_a_controller_that_drives_to_the_waypoint_tracks_it_and_violates_separations():
    metrics = evaluate(GoToWaypoint(), SCENARIO.replace(max_cycles=200), episodes=20, seed=0)
    assert metrics["tracking_error"].mean < 0.05
    assert metrics["neighbor_violation_rate"].mean > 0.3
    assert metrics["tracking_error"].low < metrics["tracking_error"].mean < metrics["tracking_error"].high
    assert metrics["tracking_error"].n == 20


def test_a_policy_needs_a_scenario_from_somewhere(network):
    with pytest.raises(SettingsError, match="scenario = None"):
        evaluate(network)


@pytest.mark.parametrize(("name", "value"), [("episodes", 0), ("seed", -1), ("batch", 0)])
def test_bad_counts_are_refused_in_one_line(name, value):
    with pytest.raises(SettingsError, match=f"^{name} = {value}"):
        evaluate(GoToWaypoint(), SCENARIO, **{"episodes": 1, name: value})


def test_a_controller_or_a_policy_becomes_a_controller(network):
    controller = GoToWaypoint()
    assert as_controller(controller, SCENARIO) is controller
    adapted = as_controller(network, SCENARIO)
    assert isinstance(adapted, PolicyController)
    assert adapted.policy is network


class OfThePreviousRelease:
    """A controller without the base class; it drives as its random streams say."""

    def reset(self, rngs, scenario):
        self.speeds = np.array([rng.uniform(0, scenario.max_speed) for rng in rngs])

    def act(self, sensing, scenario):
        actions = np.zeros((*sensing.waypoint_distances.shape, 2))
        actions[..., 0] = self.speeds[:, None]
        return actions


def test_a_controller_without_the_base_class_drives_and_warns():
    with pytest.warns(RenamedWarning, match="OfThePreviousRelease without a base class.*a subclass of Controller"):
        values = rollout(OfThePreviousRelease(), SCENARIO, 3, seed=0)
    with pytest.warns(RenamedWarning):
        one_by_one = rollout(OfThePreviousRelease(), SCENARIO, 3, seed=0, batch=1)
    np.testing.assert_array_equal(values["tracking_error"], one_by_one["tracking_error"])
    assert np.ptp(values["tracking_error"]) > 0


class PredictsNothing:
    predict = None


@pytest.mark.parametrize("policy", [object(), PredictsNothing(), None, "ddpg"])
def test_an_object_without_predict_is_refused_in_one_line(policy):
    needed = f"policy = {type(policy).__name__}: a Controller, or an object with SB3's predict, is needed"
    with pytest.raises(SettingsError) as error:
        as_controller(policy, SCENARIO)
    assert str(error.value) == needed
    with pytest.raises(SettingsError, match="is needed"):
        evaluate(policy, SCENARIO, episodes=1)


def test_a_loaded_policy_is_checked_against_the_scenario():
    policy = load_policy("ddpg")
    assert isinstance(as_controller(policy, policy.scenario), PolicyController)
    with pytest.raises(PolicyError, match="its observations have the shape"):
        as_controller(policy, policy.scenario.replace(n_anchors=9))
    with pytest.warns(UserWarning, match="link_range = 0.15, evaluated with 0.2"):
        as_controller(policy, policy.scenario.replace(link_range=0.2))


def test_a_rollout_takes_a_policy_as_evaluate_does():
    policy = load_policy("ddpg")
    scenario = policy.scenario.replace(max_cycles=20)
    values = rollout(policy, scenario, 3, 0)["tracking_error"]
    assert values.mean() == pytest.approx(evaluate(policy, scenario, 3)["tracking_error"].mean)


def test_one_episode_is_the_batchs_episode_of_that_number():
    worlds = [
        (world.steps, world.positions[0].copy(), world.waypoints[0].copy())
        for world in iter_rollout(GoToWaypoint(), SCENARIO, seed=4, episode=2)
    ]
    assert [steps for steps, *_ in worlds] == list(range(41))
    errors = [np.linalg.norm(positions - waypoint, axis=-1).mean() for steps, positions, waypoint in worlds if steps > 20]
    assert np.mean(errors) == pytest.approx(rollout(GoToWaypoint(), SCENARIO, 3, seed=4)["tracking_error"][2])
    for name in ("seed", "episode"):
        with pytest.raises(SettingsError, match=f"{name} = -1"):
            next(iter_rollout(GoToWaypoint(), SCENARIO, **{name: -1}))


def test_the_first_batch_can_be_watched():
    seen = []
    rollout(GoToWaypoint(), SCENARIO, 5, seed=2, batch=3, watch=lambda world: seen.append((world.steps, world.positions)))
    assert [steps for steps, _ in seen] == list(range(41))
    for episode in range(3):
        alone = [world.positions[0] for world in iter_rollout(GoToWaypoint(), SCENARIO, seed=2, episode=episode)]
        np.testing.assert_array_equal([positions[episode] for _, positions in seen], alone)


def test_a_batch_takes_its_controller_from_the_world():
    made = []

    def make(world):
        made.append(world)
        return make_controller("go-to-waypoint")

    values = rollout_batch(make, SCENARIO, [episode_rng(0, episode) for episode in range(3)])
    assert [(world.n_flocks, world.scenario, world.steps) for world in made] == [(3, SCENARIO, 40)]
    np.testing.assert_array_equal(values["return"], rollout(make_controller("go-to-waypoint"), SCENARIO, 3, 0)["return"])


class Predicts:
    """SB3's ``predict`` with the same numbers for every row."""

    def __init__(self, numbers):
        self.numbers = numbers

    def predict(self, observations, deterministic):
        return np.tile(np.array(self.numbers, np.float32), (len(observations), 1)), None


class Acts(GoToWaypoint):
    """A controller of one action for all."""

    def act(self, sensing, scenario):
        return np.array([0.1, 0.0])


WRONG = [
    (Predicts([np.nan, 0.0]), r"^action of flock 0 vehicle 0 = \[nan, 0.0\]: finite numbers are needed$"),
    (Predicts([0.1, np.inf]), r"^action of flock 0 vehicle 0 = \[0.1\d+, inf\]: finite numbers are needed$"),
    (Predicts([0.1]), r"^predict gives actions of the shape \(256, 1\): \(256, 2\) is needed$"),
    (Acts(), r"^actions have the shape \(2,\): \(2, 5, 2\) is needed$"),
]


@pytest.mark.parametrize(("policy", "line"), WRONG, ids=["nan", "inf", "narrow", "broadcast"])
def test_wrong_actions_are_refused_in_one_line_and_not_evaluated(policy, line, tmp_path):
    with pytest.raises(ActionError, match=line):
        evaluate(policy, SCENARIO, episodes=2)
    with pytest.raises(ActionError, match=line.replace(r"\(2, 5", r"\(1, 5")):
        list(iter_rollout(policy, SCENARIO))
    with pytest.raises(ActionError, match=line.replace(r"\(2, 5", r"\(1, 5")):
        render(policy, SCENARIO, tmp_path / "video.html")
    assert list(tmp_path.iterdir()) == []


class Recorder(GoToWaypoint):
    """Keeps what the base class is called with."""

    def __init__(self):
        self.resets = []

    def reset(self, rngs, scenario):
        self.resets.append((len(rngs), scenario))


def test_a_controller_is_reset_before_each_batch():
    controller = Recorder()
    rollout(controller, SCENARIO, 5, seed=0, batch=2)
    assert controller.resets == [(2, SCENARIO), (2, SCENARIO), (1, SCENARIO)]


class Farthest(EpisodeMetric):
    """Largest distance of a vehicle to the waypoint in the episode; registered nowhere."""

    name, unit, better, description = "farthest", "m", "lower", "largest distance of a vehicle to the waypoint"

    def __init__(self, scenario, n_flocks):
        super().__init__(scenario, n_flocks)
        self._largest = np.zeros(n_flocks)

    def update(self, step):
        self._largest = np.maximum(self._largest, step.sensing.waypoint_distances.max(-1))

    def result(self):
        return self._largest


def test_metrics_are_chosen_by_name_or_class():
    scenario = Scenario(max_cycles=10)
    chosen = evaluate(make_controller("random"), scenario, 3, metrics=["connectivity", Farthest])
    assert list(chosen) == ["connectivity", "farthest"]
    assert chosen["connectivity"] == evaluate(make_controller("random"), scenario, 3)["connectivity"]
    assert chosen["farthest"].mean > 0.5
    assert "farthest" not in METRICS


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        (["conectivity"], "metrics = 'conectivity': one of tracking_error, .*; did you mean connectivity"),
        ([dict], "metrics: .*dict.* is neither a name nor a subclass of EpisodeMetric"),
        (["return", METRICS["return"]], "metrics: return is named twice"),
    ],
)
def test_metrics_that_cannot_be_are_refused(metrics, message):
    with pytest.raises(SettingsError, match=message):
        evaluate(make_controller("random"), Scenario(max_cycles=10), 1, metrics=metrics)
