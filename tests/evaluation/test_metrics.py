import numpy as np
import pytest

from sb3_flock.evaluation import METRICS, EpisodeMetrics, summarize
from sb3_flock.evaluation.metrics import score
from sb3_flock.sim import Scenario, sense
from tests.helpers import place

SCENARIO = Scenario(n_vehicles=3, n_obstacles=1, max_cycles=4)


def gather(steps, scenario=SCENARIO):
    """Metrics of an episode given as (positions, obstacles, waypoint, rewards) a step."""
    metrics = EpisodeMetrics(scenario, 1)
    for positions, obstacles, waypoint, rewards in steps:
        world = place(scenario, positions, [0.0] * len(positions), obstacles, waypoint)
        metrics.update(world, sense(world), np.array([rewards], dtype=float))
    return {name: value[0] for name, value in metrics.result().items()}


def test_every_metric_by_hand():
    close = [(0.0, 0.0), (0.12, 0.0), (0.0, 0.05)]  # 0 and 2 are too close; 1 and 2 are 0.13 apart
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
    assert values["success_rate"] == 0.0  # it ends well, but there was a violation
    assert values["return"] == pytest.approx(6 / 3 + 3 / 3 - 3 / 3)


def test_success_needs_a_clean_flight_and_a_good_end():
    good = ([(0.0, 0.0), (0.12, 0.0), (0.06, 0.11)], [(1.0, 1.0)], (0.06, 0.04), (0, 0, 0))
    far = ([(0.5, 0.0), (0.62, 0.0), (0.56, 0.11)], [(1.0, 1.0)], (0.06, 0.04), (0, 0, 0))
    split = ([(0.14, 0.0), (-0.14, 0.0), (0.0, 0.14)], [(1.0, 1.0)], (0.0, 0.0), (0, 0, 0))  # all near, none linked
    assert gather([good] * 4)["success_rate"] == 1.0
    assert gather([far, far, far, good])["success_rate"] == 1.0
    assert gather([good, good, good, far])["success_rate"] == 0.0
    assert gather([good, good, good, split])["success_rate"] == 0.0


def test_thresholds_are_strict():
    exact = SCENARIO.replace(neighbor_separation=0.125, link_range=0.25, obstacle_separation=0.25, detection_range=0.5)
    values = gather([([(0.0, 0.0), (0.125, 0.0), (-0.25, 0.0)], [(0.0, 0.25)], (0.0, 0.0), (0, 0, 0))] * 4, exact)
    assert values["neighbor_violation_rate"] == values["obstacle_violation_rate"] == 0.0
    assert values["connectivity"] == 0.0


def test_the_settled_window_is_the_second_half():
    near, far = [(0.1, 0.0)], [(0.9, 0.0)]
    one = Scenario(n_vehicles=1, n_obstacles=0, max_cycles=5)  # T/2 = 2.5: steps 3, 4 and 5 are settled
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


def test_the_score_prefers_safe_and_connected():
    base = {"tracking_error": 0.1, "neighbor_violation_rate": 0.0, "obstacle_violation_rate": 0.0, "connectivity": 1.0}
    assert score(base) == pytest.approx(0.1)
    assert score({**base, "neighbor_violation_rate": 0.01}) == pytest.approx(0.12)
    assert score({**base, "obstacle_violation_rate": 0.01}) == pytest.approx(0.14)
    assert score({**base, "connectivity": 0.9}) == pytest.approx(0.12)
    assert score({**base, "neighbor_violation_rate": float("nan")}) == pytest.approx(0.1)
