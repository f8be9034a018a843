import io
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from sb3_flock import FlockEvalCallback, make_vec_env
from sb3_flock.controllers import make_controller
from sb3_flock.evaluation import METRICS, EpisodeMetric, EpisodeMetrics, evaluate, register_metric, summarize
from sb3_flock.evaluation.metrics import columns, is_higher_better, lattice_rings, score, wilson_interval
from sb3_flock.evaluation.report import metrics_table, short_cells, short_summary, write_json
from sb3_flock.rl.registry import build_model
from sb3_flock.sim import Scenario, World, episode_rng
from tests.helpers import SMALL_MODEL, place

SCENARIO = Scenario(n_vehicles=3, n_obstacles=1, max_cycles=4)


def gather(steps, scenario=SCENARIO):
    """Metrics of an episode given as (positions, obstacles, waypoint, rewards) a step."""
    metrics = EpisodeMetrics(scenario, 1)
    for positions, obstacles, waypoint, rewards in steps:
        world = place(scenario, positions, [0.0] * len(positions), obstacles, waypoint)
        metrics.update(world, world.sense(), np.array([rewards], dtype=float))
    return {name: value[0] for name, value in metrics.result().items()}


def test_every_metric_by_hand():
    close = [(0.0, 0.0), (0.12, 0.0), (0.0, 0.05)]  # 0 and 2 violate their separation; 1 and 2 are 0.13 apart
    apart = [(0.0, 0.0), (0.12, 0.0), (0.5, 0.0)]  # 2 is alone
    chain = [(0.0, 0.0), (0.12, 0.0), (0.24, 0.0)]  # connected, the ends not linked
    values = gather(
        [
            (close, [(0.0, -0.11)], (0.0, 0.0), (1, 2, 3)),  # 0.11 from vehicle 0, over 0.15 from the others
            (apart, [(1.0, 1.0)], (0.0, 0.0), (0, 0, 0)),
            (apart, [(1.0, 1.0)], (0.0, 0.0), (1, 1, 1)),
            (chain, [(1.0, 1.0)], (0.12, 0.0), (0, 0, -3)),
        ]
    )
    assert set(values) == set(METRICS)
    assert values["tracking_error"] == pytest.approx(((0 + 0.12 + 0.5) + (0.12 + 0 + 0.12)) / 6)
    assert values["tracking_error_episode"] == pytest.approx((0.17 + 0.62 + 0.62 + 0.24) / 12)
    assert values["min_separation_neighbors"] == pytest.approx(0.05)
    assert values["min_separation_obstacles"] == pytest.approx(0.11)
    assert values["encounter_min_separation_obstacles"] == pytest.approx(0.11)
    assert values["mean_separation"] == pytest.approx((0.12 + 0.5 + 0.38 + 0.12 + 0.12 + 0.24) / 6)
    assert values["mean_separation_linked"] == pytest.approx(0.12)
    assert values["neighbor_violation_rate"] == pytest.approx(2 / 12)
    assert values["obstacle_violation_rate"] == pytest.approx(1 / 12)
    assert values["connectivity"] == 0.5
    assert values["violation_free_rate"] == 0.0
    assert values["success_rate"] == 0.0  # it ends well, but there was a violation
    assert values["return"] == pytest.approx(6 / 3 + 3 / 3 - 3 / 3)


def reference(scenario, episode):
    """Every built-in metric of one episode by loops over bodies, from (positions, obstacles, waypoint, rewards) a step."""
    n, horizon = scenario.n_vehicles, scenario.max_cycles
    errors, all_errors, pair_means, linked, connected = [], [], [], [], []
    smallest_pair = smallest_obstacle = np.inf
    neighbor_violations = obstacle_violations = 0
    arrived, radius = False, scenario.link_range * (1 if n <= 7 else 2)
    for k, (positions, obstacles, waypoint, _) in enumerate(episode, start=1):
        distances = [float(np.hypot(*(position - waypoint))) for position in positions]
        all_errors += distances
        links = {i: set() for i in range(n)}
        pairs = []
        violating = set()
        for i in range(n):
            for j in range(i):
                distance = float(np.hypot(*(positions[i] - positions[j])))
                pairs.append(distance)
                if distance < scenario.link_range:
                    links[i].add(j)
                    links[j].add(i)
                if distance < scenario.neighbor_separation:
                    violating |= {i, j}
            clearances = [float(np.hypot(*(positions[i] - obstacle))) for obstacle in obstacles]
            smallest_obstacle = min([smallest_obstacle, *clearances])
            obstacle_violations += any(clearance < scenario.obstacle_separation for clearance in clearances)
        smallest_pair = min([smallest_pair, *pairs])
        neighbor_violations += len(violating)
        reached, waiting = {0}, [0]
        while waiting:
            new = links[waiting.pop()] - reached
            reached |= new
            waiting += new
        if 2 * k > horizon:
            errors += distances
            pair_means += pairs
            linked += [distance for distance in pairs if distance < scenario.link_range]
            connected.append(len(reached) == n)
            arrived = connected[-1] and max(distances) < radius
    meets = smallest_obstacle < scenario.detection_range
    nan = float("nan")
    return {
        "tracking_error": np.mean(errors),
        "tracking_error_episode": np.mean(all_errors),
        "min_separation_obstacles": smallest_obstacle if scenario.n_obstacles else nan,
        "encounter_min_separation_obstacles": smallest_obstacle if scenario.n_obstacles and meets else nan,
        "min_separation_neighbors": smallest_pair if n > 1 else nan,
        "mean_separation": np.mean(pair_means) if n > 1 else nan,
        "mean_separation_linked": np.mean(linked) if linked else nan,
        "obstacle_violation_rate": obstacle_violations / (n * horizon) if scenario.n_obstacles else nan,
        "neighbor_violation_rate": neighbor_violations / (n * horizon) if n > 1 else nan,
        "connectivity": np.mean(connected),
        "violation_free_rate": float(not neighbor_violations and not obstacle_violations),
        "success_rate": float(arrived and not neighbor_violations and not obstacle_violations),
        "return": sum(np.mean(rewards) for *_, rewards in episode),
    }


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(0, 3), st.integers(1, 9), st.floats(0.05, 0.6))
def test_every_metric_against_loops_over_the_bodies(seed, n_vehicles, n_obstacles, max_cycles, spread):
    scenario = Scenario(n_vehicles=n_vehicles, n_obstacles=n_obstacles, max_cycles=max_cycles)
    rng, flocks = np.random.default_rng(seed), 3
    world, metrics = World(scenario, flocks), EpisodeMetrics(scenario, flocks)
    world.reset([episode_rng(seed, flock) for flock in range(flocks)])
    episodes = [[] for _ in range(flocks)]
    for _ in range(max_cycles):
        world.positions = rng.uniform(-spread, spread, (flocks, n_vehicles, 2))
        world.obstacle_positions = rng.uniform(-spread, spread, (flocks, n_obstacles, 2))
        world.waypoints = rng.uniform(-spread, spread, (flocks, 2))
        rewards = rng.normal(size=(flocks, n_vehicles))
        metrics.update(world, world.sense(), rewards)
        for flock, episode in enumerate(episodes):
            bodies = world.positions[flock], world.obstacle_positions[flock], world.waypoints[flock]
            episode.append((*bodies, rewards[flock]))
    expected = [reference(scenario, episode) for episode in episodes]
    assert set(expected[0]) == set(METRICS)
    for name, values in metrics.result().items():
        np.testing.assert_allclose(values, [row[name] for row in expected], rtol=1e-9, atol=1e-12, err_msg=name)


def test_success_needs_no_violation_and_a_connected_end_at_the_waypoint():
    good = ([(0.0, 0.0), (0.12, 0.0), (0.06, 0.11)], [(1.0, 1.0)], (0.06, 0.04), (0, 0, 0))
    far = ([(0.5, 0.0), (0.62, 0.0), (0.56, 0.11)], [(1.0, 1.0)], (0.06, 0.04), (0, 0, 0))
    split = ([(0.14, 0.0), (-0.14, 0.0), (0.0, 0.14)], [(1.0, 1.0)], (0.0, 0.0), (0, 0, 0))  # all near, none linked
    assert gather([good] * 4)["success_rate"] == 1.0
    assert gather([far, far, far, good])["success_rate"] == 1.0
    assert gather([good, good, good, far])["success_rate"] == 0.0
    assert gather([good, good, good, split])["success_rate"] == 0.0


def lattice(n_vehicles, edge):
    """The nearest points of a hexagonal lattice around the origin."""
    span = range(-5, 6)
    points = [(edge * (i + j / 2), edge * j * 3**0.5 / 2) for i in span for j in span]
    return sorted(points, key=lambda point: round(np.hypot(*point), 9))[:n_vehicles]


@pytest.mark.parametrize("n", [1, 2, 7, 8, 19, 20, 37, 38, 61])
def test_flocks_of_any_size_can_succeed_within_the_rings_that_hold_them(n):
    scenario = Scenario(n_vehicles=n, n_obstacles=0, max_cycles=2)
    reach = lattice_rings(n) * scenario.link_range
    loose, dense = lattice(n, 0.999 * scenario.link_range), lattice(n, 1.05 * scenario.neighbor_separation)
    east = max(dense)
    for positions, waypoint, success in (
        (loose, (0.0, 0.0), 1.0),
        (dense, (east[0] - 0.999 * reach, east[1]), 1.0),
        (dense, (east[0] - 1.001 * reach, east[1]), 0.0),
    ):
        assert gather([(positions, [], waypoint, [0] * n)] * 2, scenario)["success_rate"] == success


def test_up_to_seven_vehicles_must_be_within_link_range_of_the_waypoint():
    assert [lattice_rings(n) for n in (1, 2, 3, 5, 7, 8, 19, 20, 200)] == [1, 1, 1, 1, 1, 2, 2, 3, 8]


def test_an_episode_is_free_whatever_its_end_unless_a_separation_is_violated_once():
    split = ([(0.14, 0.0), (-0.14, 0.0), (0.0, 0.14)], [(1.0, 1.0)], (0.9, 0.0), (0, 0, 0))
    close = ([(0.14, 0.0), (-0.14, 0.0), (0.08, 0.0)], [(1.0, 1.0)], (0.9, 0.0), (0, 0, 0))
    near = ([(0.14, 0.0), (-0.14, 0.0), (0.0, 0.14)], [(0.0, -0.05)], (0.9, 0.0), (0, 0, 0))
    assert gather([split] * 4)["violation_free_rate"] == 1.0
    assert gather([close, split, split, split])["violation_free_rate"] == 0.0
    assert gather([split, split, split, near])["violation_free_rate"] == 0.0


def test_thresholds_are_strict():
    exact = SCENARIO.replace(neighbor_separation=0.125, link_range=0.25, obstacle_separation=0.25, detection_range=0.5)
    values = gather([([(0.0, 0.0), (0.125, 0.0), (-0.25, 0.0)], [(0.0, 0.25)], (0.0, 0.0), (0, 0, 0))] * 4, exact)
    assert values["neighbor_violation_rate"] == values["obstacle_violation_rate"] == 0.0
    assert values["connectivity"] == 0.0


def test_the_steady_state_is_the_second_half():
    near, far = [(0.1, 0.0)], [(0.9, 0.0)]
    one = Scenario(n_vehicles=1, n_obstacles=0, max_cycles=5)  # T/2 = 2.5: steps 3, 4 and 5 are the steady state
    steps = [(position, [], (0.0, 0.0), (0,)) for position in (far, far, near, near, near)]
    assert gather(steps, one)["tracking_error"] == pytest.approx(0.1)


def test_a_lone_vehicle_without_obstacles_leaves_pair_and_obstacle_metrics_undefined():
    one = Scenario(n_vehicles=1, n_obstacles=0, max_cycles=2)
    values = gather([([(0.1, 0.0)], [], (0.0, 0.0), (1,))] * 2, one)
    undefined = {name for name, value in values.items() if np.isnan(value)}
    assert undefined == {
        "min_separation_obstacles", "encounter_min_separation_obstacles", "min_separation_neighbors", "mean_separation",
        "mean_separation_linked", "obstacle_violation_rate", "neighbor_violation_rate",
    }  # fmt: skip
    assert values["connectivity"] == 1.0
    summary = summarize({name: np.array([value]) for name, value in values.items()})
    assert summary["mean_separation"].mean is None
    assert summary["mean_separation"].n == 0


def test_an_obstacle_that_stays_away_is_no_encounter():
    values = gather([([(0.0, 0.0)] * 3, [(0.0, 0.3)], (0.0, 0.0), (0, 0, 0))] * 4)
    assert values["min_separation_obstacles"] == pytest.approx(0.3)
    assert np.isnan(values["encounter_min_separation_obstacles"])


def test_summaries_leave_undefined_episodes_out_and_count():
    values = np.array([1.0, np.nan, 3.0, 2.0])
    summary = summarize({"tracking_error": values, "min_separation_neighbors": values})
    assert summary["tracking_error"].mean == 2.0
    assert summary["tracking_error"].n == 3
    assert summary["tracking_error"].worst is None
    assert summary["min_separation_neighbors"].worst == 1.0


def test_the_interval_is_the_percentile_bootstrap():
    values = np.random.default_rng(5).normal(size=150)
    metric = summarize({"return": values})["return"]
    rng = np.random.default_rng(0)
    means = values[rng.integers(150, size=(10_000, 150))].mean(1)
    # Drawn in chunks, the indices are the same stream.
    np.testing.assert_allclose([metric.low, metric.high], np.percentile(means, [2.5, 97.5]), rtol=1e-12)
    assert metric.high - metric.low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(150), rel=0.05)


@given(st.integers(1, 5000), st.floats(0, 1))
def test_an_end_of_wilsons_interval_is_a_share_from_which_the_observed_one_is_z_standard_errors_away(n, share):
    share = round(share * n) / n
    low, high = wilson_interval(share, n)
    assert 0 <= low <= share <= high <= 1
    for end in (low, high):
        error = (end * (1 - end) / n) ** 0.5
        assert abs(share - end) == pytest.approx(1.959964 * error, rel=1e-5, abs=1e-9)


def test_episodes_that_are_all_alike_leave_an_interval_where_a_metric_is_0_or_1_in_each():
    names = ("violation_free_rate", "success_rate", "connectivity")
    summary = summarize({name: np.ones(1000) for name in names})
    for name in names[:2]:
        assert (summary[name].mean, summary[name].high, summary[name].n) == (1.0, 1.0, 1000)
        assert summary[name].low == pytest.approx(1000 / (1000 + 1.959964**2), rel=1e-9)
    assert summary["connectivity"].low == 1.0  # a mean over steps: the bootstrap
    none = summarize({"success_rate": np.zeros(10)})["success_rate"]
    assert (none.mean, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(0.2775, abs=1e-4)
    one = summarize({"success_rate": np.array([0.0, 1.0, np.nan, 1.0, 1.0])})["success_rate"]  # 3 of 4
    assert (one.low, one.high) == pytest.approx((0.3006, 0.9544), abs=1e-4)
    assert [name for name, metric in METRICS.items() if metric.is_binary] == ["violation_free_rate", "success_rate"]


def test_the_score_adds_violations_and_lost_connectivity_to_the_tracking_error():
    base = {"tracking_error": 0.1, "neighbor_violation_rate": 0.0, "obstacle_violation_rate": 0.0, "connectivity": 1.0}
    assert score(base) == pytest.approx(0.1)
    assert score({**base, "neighbor_violation_rate": 0.01}) == pytest.approx(0.12)
    assert score({**base, "obstacle_violation_rate": 0.01}) == pytest.approx(0.14)
    assert score({**base, "connectivity": 0.9}) == pytest.approx(0.12)
    assert score({**base, "neighbor_violation_rate": float("nan")}) == pytest.approx(0.1)


def test_every_metric_names_its_unit_direction_and_description():
    for name, metric in METRICS.items():
        assert metric.name == name
        assert metric.unit in {"m", ""}
        assert metric.better in {"lower", "higher"}
        assert is_higher_better(name) == (metric.better == "higher")
        assert metric.description
        assert ("[m]" in metric.description) == (metric.unit == "m"), name
    assert list(columns()) == [
        "tracking_error", "obstacle_violation_rate", "neighbor_violation_rate", "connectivity", "violation_free_rate",
        "success_rate",
    ]  # fmt: skip
    assert not is_higher_better("score")


# A metric registered outside the package


class MeanSpeed(EpisodeMetric):
    """Mean speed of the vehicles, of which the base class knows nothing."""

    name, unit, better, column = "mean_speed", "m/s", "higher", "speed"
    description = "mean speed over vehicles and steps [m/s]"

    def __init__(self, scenario, n_flocks):
        super().__init__(scenario, n_flocks)
        self._distance, self._steps = np.zeros(n_flocks), 0

    def update(self, step):
        self._distance += step.sensing.ego_motion[..., 0].mean(-1)
        self._steps += 1

    def result(self):
        return self._distance / (self._steps * self.scenario.time_step)


@pytest.fixture
def _mean_speed(restored):
    restored(METRICS)
    assert register_metric(MeanSpeed) is MeanSpeed
    assert register_metric(MeanSpeed) is MeanSpeed  # the same class again is no error


def shown(table, width):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


@pytest.mark.usefixtures("_mean_speed")
def test_a_registered_metric_is_in_the_results_the_tables_and_the_json(tmp_path):
    scenario = Scenario(max_cycles=10)
    metrics = evaluate(make_controller("random"), scenario, episodes=20)
    assert metrics["mean_speed"].n == 20
    assert metrics["mean_speed"].mean == pytest.approx(0.075, abs=0.01)
    assert metrics["mean_speed"].worst is None
    rows = shown(metrics_table(metrics, scenario), 80).splitlines()
    assert [row.split()[:2] for row in rows if row.strip().startswith("mean_speed")] == [
        ["mean_speed", f"{metrics['mean_speed'].mean:.3f}"]
    ]
    means = {name: metric.mean for name, metric in metrics.items()}
    assert short_cells(means)[-1] == f"{metrics['mean_speed'].mean:.3f}"
    assert short_summary(means).endswith(f", speed {metrics['mean_speed'].mean:.3f}")
    write_json(tmp_path / "out.json", metrics, {})
    written = json.loads((tmp_path / "out.json").read_text())["metrics"]["mean_speed"]
    assert written["mean"] == metrics["mean_speed"].mean
    assert set(written) == {"mean", "low", "high", "n"}


@pytest.mark.usefixtures("_mean_speed")
def test_a_registered_metric_is_in_the_history_of_the_evaluations(tmp_path):
    lines = []
    callback = FlockEvalCallback(Scenario(max_cycles=5), 30, 3, tmp_path, report=lines.append)
    model = build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, 1, seed=0))
    model.learn(60, callback)
    history = callback.state_dict()["history"]
    assert len(history["mean_speed"]) == len(history["timesteps"]) == len(lines) >= 2
    assert all(0.0 <= speed <= 0.15 for speed in history["mean_speed"])
    assert all(", speed 0." in line for line in lines)
    np.testing.assert_array_equal(np.load(tmp_path / "evaluations.npz")["mean_speed"], history["mean_speed"])


@pytest.mark.usefixtures("_mean_speed")
@pytest.mark.parametrize("name", ["mean_speed", "connectivity"])
def test_a_metrics_name_is_taken_once(name):
    with pytest.raises(ValueError, match=f"metric '{name}' is registered already"):
        register_metric(type("Other", (MeanSpeed,), {"name": name}))


def test_a_metric_without_a_column_is_in_no_short_table(restored):
    restored(METRICS)
    before = short_summary({})
    register_metric(type("Hidden", (MeanSpeed,), {"name": "hidden", "column": None}))
    assert short_summary({}) == before
    assert "hidden" in evaluate(make_controller("random"), Scenario(max_cycles=3), episodes=2)
