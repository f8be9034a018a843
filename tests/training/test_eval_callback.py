import numpy as np
import pytest
from stable_baselines3.common.logger import Figure

from sb3_flock import FlockDDPG, FlockEvalCallback, FlockPolicy, NeighborInclusiveReward, evaluate, make_vec_env
from sb3_flock.evaluation.metrics import score
from sb3_flock.sim import Scenario
from sb3_flock.training.eval_callback import SELECTION_SEED

SCENARIO = Scenario(max_cycles=10)
EASIER = SCENARIO.replace(n_vehicles=2, n_obstacles=0)


def learn(callback, steps=96, **kwargs):
    """A plain script of SB3: no config, no run folder."""
    kwargs = {"learning_starts": 30, "batch_size": 8, "buffer_size": 200, "learning_rate": 0.01, **kwargs}
    policy_kwargs = {"features_extractor_kwargs": {"features_dim": 8, "channels": (4,)}, "net_arch": [8]}
    env = make_vec_env(SCENARIO, n_flocks=2, seed=0)
    model = FlockDDPG(FlockPolicy, env, policy_kwargs=policy_kwargs, seed=0, device="cpu", **kwargs)
    return model.learn(steps, callback=[NeighborInclusiveReward(0.7), callback])


def test_a_plain_script_evaluates_on_time_and_at_the_end(tmp_path):
    lines = []
    callback = FlockEvalCallback(EASIER, eval_freq=40, n_eval_episodes=3, folder=tmp_path, report=lines.append)
    model = learn(callback)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [42, 84, 96]
    assert evaluations["results"].shape == (3, 3)
    assert (evaluations["ep_lengths"] == 10).all()
    assert [line.split(":")[0] for line in lines] == ["evaluation at 42", "evaluation at 84", "evaluation at 96"]
    assert f"score {evaluations['score'][-1]:.3f}" in lines[-1]
    # The last evaluation is of the final model, on the documented episodes.
    metrics = evaluate(model, EASIER, episodes=3, seed=SELECTION_SEED)
    assert evaluations["tracking_error"][-1] == pytest.approx(metrics["tracking_error"].mean, rel=1e-12)
    means = {name: np.nan if metric.mean is None else metric.mean for name, metric in metrics.items()}
    assert evaluations["score"][-1] == pytest.approx(score(means), rel=1e-12)
    assert evaluations["results"][-1].mean() == pytest.approx(metrics["return"].mean, rel=1e-12)


def test_the_model_with_the_lowest_score_is_kept_as_sb3_saves_it(tmp_path):
    lines = []
    learn(FlockEvalCallback(SCENARIO, 12, 3, tmp_path, report=lines.append), steps=200)
    evaluations = np.load(tmp_path / "evaluations.npz")
    best = int(evaluations["score"].argmin())
    kept = FlockDDPG.load(tmp_path / "best_model.zip", device="cpu")
    assert kept.num_timesteps == evaluations["timesteps"][best]
    metrics = evaluate(kept, SCENARIO, episodes=3, seed=SELECTION_SEED)
    assert metrics["tracking_error"].mean == pytest.approx(evaluations["tracking_error"][best], rel=1e-12)
    records = [
        value < min(evaluations["score"][:number], default=np.inf) for number, value in enumerate(evaluations["score"])
    ]
    assert [line.endswith("(best)") for line in lines] == records


def test_another_save_is_called_for_each_new_best(tmp_path):
    saved = []

    def save_best(model, path):
        saved.append((path, callback.best_score))

    callback = FlockEvalCallback(SCENARIO, 12, 3, tmp_path, save_best)
    learn(callback)
    assert {path for path, _ in saved} == {tmp_path / "best_model.zip"}
    scores = [value for _, value in saved]
    assert scores == sorted(scores, reverse=True)
    assert not (tmp_path / "best_model.zip").exists()


def test_without_a_folder_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = FlockEvalCallback(SCENARIO, 40, 2)
    learn(callback)
    assert not list(tmp_path.iterdir())
    assert np.isfinite(callback.best_score)


def test_a_frequency_of_zero_is_no_evaluation(tmp_path):
    callback = FlockEvalCallback(SCENARIO, 0, 2, tmp_path, report=pytest.fail)
    learn(callback)
    assert callback.best_score == np.inf
    assert not list(tmp_path.iterdir())


def test_a_restored_callback_continues_its_evaluations(tmp_path):
    first = FlockEvalCallback(SCENARIO, 40, 2, tmp_path)
    learn(first, steps=60)
    before = dict(np.load(tmp_path / "evaluations.npz"))

    class Restored(FlockEvalCallback):
        def _on_training_start(self):
            super()._on_training_start()
            self.load_state_dict(first.state_dict())

    second = Restored(SCENARIO, 40, 2, tmp_path)
    learn(second, steps=96)
    after = np.load(tmp_path / "evaluations.npz")
    assert before["timesteps"].tolist() == [42, 60]
    assert after["timesteps"].tolist() == [42, 60, 84, 96]
    np.testing.assert_array_equal(after["tracking_error"][:2], before["tracking_error"])
    assert (np.diff(after["seconds"]) > 0).all()
    assert second.best_score <= first.best_score


def test_a_run_that_began_without_a_metric_continues_with_it(tmp_path):
    first = FlockEvalCallback(SCENARIO, 40, 2, tmp_path)
    learn(first, steps=60)
    state = first.state_dict()
    del state["history"]["violation_free_rate"]

    class Restored(FlockEvalCallback):
        def _on_training_start(self):
            super()._on_training_start()
            self.load_state_dict(state)

    learn(Restored(SCENARIO, 40, 2, tmp_path), steps=96)
    after = np.load(tmp_path / "evaluations.npz")
    assert np.isnan(after["violation_free_rate"]).tolist() == [True, True, False, False]
    assert not np.isnan(after["success_rate"]).any()


def test_evaluations_are_logged_under_eval(tmp_path):
    logged = []

    class Keep(FlockEvalCallback):
        def _evaluate(self):
            dump, self.logger.dump = self.logger.dump, lambda step: logged.append((step, dict(self.logger.name_to_value)))
            super()._evaluate()
            self.logger.dump = dump
            self.logger.dump(self.num_timesteps)

    learn(Keep(SCENARIO, 40, 2, tmp_path))
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert [step for step, _ in logged] == evaluations["timesteps"].tolist()
    for number, (_, values) in enumerate(logged):
        for name in ("tracking_error", "connectivity", "violation_free_rate", "score"):
            assert values[f"eval/{name}"] == evaluations[name][number]
        assert isinstance(values["eval/trajectory"], Figure)
