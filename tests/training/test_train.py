"""Smoke trainings of every algorithm, and what a run folder holds."""

import io
import json
import signal
import zipfile

import numpy as np
import pytest
import torch as th
from rich.console import Console

from sb3_flock import evaluate, load_policy, train
from sb3_flock.config.training import TrainingConfig
from sb3_flock.rl.registry import ALGORITHMS
from sb3_flock.serialization.load import PolicyError
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import UserError
from sb3_flock.training.train import cores, make_training_env
from tests.helpers import quiet, tiny


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_each_algorithm_trains_saves_and_loads(algo, tmp_path):
    config = tiny(tmp_path, algo=algo)
    result = train(config, quiet())
    model = result.model
    assert model.num_timesteps == 300
    assert model._n_updates == 2 * (300 - 60) // 6
    fresh = _untrained(config)
    for name, before in fresh.items():
        assert not th.equal(before, model.policy.state_dict()[name]), name  # every parameter moved

    observations = np.random.default_rng(0).random((7, 3, 11, 11)).astype(np.float32)
    expected, _ = model.predict(observations, deterministic=True)
    final = result.folder / "final_model.zip"
    for loaded in (ALGORITHMS[algo].load()[0].load(final, device="cpu"), load_policy(final)):
        actions, _ = loaded.predict(observations, deterministic=True)
        np.testing.assert_array_equal(actions, expected)


def _untrained(config):
    from sb3_flock import make_vec_env
    from sb3_flock.rl.registry import build_model

    model = build_model(config, make_vec_env(config.training_scenarios()[0], config.n_flocks, seed=0))
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def test_one_update_a_transition_as_in_the_paper(tmp_path):
    model = train(tiny(tmp_path, utd_ratio=1, train_freq=2, eval_freq=0), quiet()).model
    assert model.gradient_steps == 2 * 6
    assert model._n_updates == 300 - 60


def test_the_run_folder_holds_every_documented_file(tmp_path):
    config = tiny(tmp_path)
    result = train(config, quiet(), command=["sb3-flock", "train"])
    folder = result.folder
    assert folder == tmp_path / "runs" / "ddpg_3v1o_1"
    names = {path.name for path in folder.iterdir()}
    assert names >= {
        "config.yaml", "command.txt", "versions.txt", "progress.csv", "evaluations.npz", "best_model.zip", "final_model.zip",
        "rl_model_150_steps.zip", "rl_model_300_steps.zip",
    }  # fmt: skip
    assert any(name.startswith("events.out.tfevents") for name in names)
    assert {name for name in names if name.startswith(".")} <= {".lock"}
    assert load_config(TrainingConfig, folder / "config.yaml") == config
    assert (folder / "command.txt").read_text() == "sb3-flock train\n"
    assert "torch==" in (folder / "versions.txt").read_text()
    evaluations = np.load(folder / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [120, 240, 300]
    assert evaluations["results"].shape == evaluations["ep_lengths"].shape == (3, 2)
    assert {"tracking_error", "score", "connectivity"} <= set(evaluations)
    assert (np.diff(evaluations["seconds"]) > 0).all()


def test_the_best_model_is_the_one_with_the_lowest_score(tmp_path):
    result = train(tiny(tmp_path, eval_freq=60), quiet())
    evaluations = np.load(result.folder / "evaluations.npz")
    best = load_policy(result.folder)
    assert best.path == result.best_model
    assert best.num_timesteps == evaluations["timesteps"][evaluations["score"].argmin()]


@pytest.mark.parametrize(("threads", "batch_size", "expected"), [(0, 128, 1), (0, 1024, cores()), (2, 128, 2)])
def test_torch_threads_follow_the_batch_and_the_cores_unless_given(tmp_path, threads, batch_size, expected):
    train(tiny(tmp_path, torch_threads=threads, batch_size=batch_size, eval_freq=0, save_freq=0), quiet())
    assert th.get_num_threads() == expected


@pytest.mark.parametrize(
    ("available", "omp", "threads", "expected"),
    [(1, None, 0, 1), (2, None, 0, 2), (8, "4", 0, 2), (8, "1", 0, 1), (8, "1", 2, 2), (8, None, 1, 1)],
)
def test_the_update_has_two_threads_where_two_cores_may_be_used(tmp_path, monkeypatch, available, omp, threads, expected):
    monkeypatch.setattr("sb3_flock.training.train.cores", lambda: available)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if omp:
        monkeypatch.setenv("OMP_NUM_THREADS", omp)
    config = tiny(tmp_path, torch_threads=threads, total_timesteps=30, eval_freq=0, save_freq=0)
    assert train(config, quiet()).model.update_threads == expected


def test_this_process_may_use_a_core():
    assert cores() >= 1


def test_one_seed_trains_the_same_policy_twice_and_another_a_different_one(tmp_path):
    policies = []
    for seed in (5, 5, 6):
        model = train(tiny(tmp_path, seed=seed, eval_freq=0, save_freq=0), quiet()).model
        policies.append(np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()]))
    np.testing.assert_array_equal(policies[0], policies[1])
    assert not np.array_equal(policies[0], policies[2])
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["ddpg_3v1o_1", "ddpg_3v1o_2", "ddpg_3v1o_3"]


def test_evaluations_do_not_change_the_training(tmp_path):
    parameters = []
    for eval_freq in (0, 60):
        model = train(tiny(tmp_path, eval_freq=eval_freq), quiet()).model
        parameters.append(np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()]))
    np.testing.assert_array_equal(parameters[0], parameters[1])


def test_logs_have_the_four_groups(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    result = train(tiny(tmp_path, total_timesteps=1000), quiet())
    events = EventAccumulator(str(result.folder), size_guidance={"images": 0})
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {
        "rollout/ep_rew_mean", "rollout/ep_mixed_rew_mean", "train/critic_loss", "train/action_noise_std", "eval/tracking_error",
        "eval/score", "flock/tracking_error", "flock/neighbor_violation", "flock/waypoint",
    } <= tags  # fmt: skip
    images = events.Images("eval/trajectory")
    assert [image.step for image in images] == [event.step for event in events.Scalars("eval/score")]
    assert images[0].encoded_image_string != images[-1].encoded_image_string


def test_a_zip_holds_its_task_and_versions_and_a_policy_drives_any_number(tmp_path):
    result = train(tiny(tmp_path, n_vehicles=2, link_range=0.2), quiet())
    with zipfile.ZipFile(result.best_model) as archive:
        member = json.loads(archive.read("flock.json"))
    assert member["config"]["algo"] == "ddpg"
    assert member["config"]["scenario"]["link_range"] == 0.2
    assert {"stable_baselines3", "torch", "sb3_flock", "python"} <= set(member["versions"])
    policy = load_policy(result.best_model)
    assert policy.scenario.n_vehicles == 2
    metrics = evaluate(policy, policy.scenario.replace(n_vehicles=6, n_obstacles=3), episodes=3, seed=1)
    assert metrics["tracking_error"].n == 3
    assert evaluate(policy, episodes=2)["return"].n == 2
    with pytest.warns(UserWarning, match=r"trained with link_range = 0\.2, evaluated with 0\.15"):
        evaluate(policy, policy.scenario.replace(link_range=0.15), episodes=1)
    for change in ({"n_anchors": 9}, {"motion_lag": 0.2}):
        with pytest.raises(
            PolicyError, match=r"its observations have the shape \(3, 11, 11\), the scenario's \(n_anchors = "
        ):
            evaluate(policy, policy.scenario.replace(**change), episodes=1)


def test_a_policy_on_another_motion_lag_warns_or_is_refused(tmp_path):
    policy = load_policy(train(tiny(tmp_path, motion_lag=0.2), quiet()).folder)
    assert evaluate(policy, episodes=2)["return"].n == 2
    with pytest.warns(UserWarning, match=r"trained with motion_lag = 0\.2, evaluated with 0\.4"):
        evaluate(policy, policy.scenario.replace(motion_lag=0.4), episodes=1)
    with pytest.raises(PolicyError, match=r"the shape \(6, 11, 11\), the scenario's .* have \(3, 11, 11\)"):
        evaluate(policy, policy.scenario.replace(motion_lag=0.0), episodes=1)


@pytest.mark.parametrize("channels", [[8], [4, 8, 8]])
def test_any_number_of_convolutions(tmp_path, channels):
    kernel = {"kernel_size": 2} if len(channels) > 2 else {}
    result = train(tiny(tmp_path, channels=channels, **kernel), quiet())
    assert load_policy(result.folder).config.network.channels == tuple(channels)
    assert evaluate(load_policy(result.folder), episodes=1)["return"].n == 1


def test_a_training_can_start_from_trained_weights(tmp_path):
    first = train(tiny(tmp_path), quiet())
    second = train(tiny(tmp_path, init_from=str(first.folder), learning_starts=10**6, eval_freq=0), quiet())
    loaded = load_policy(first.best_model).policy.state_dict()
    for name, value in second.model.policy.state_dict().items():
        assert th.equal(value, loaded[name])
    folders = sorted((tmp_path / "runs").iterdir())
    for misfit in ({"features_dim": 32}, {"action_bound": "tanh"}, {"algo": "td3"}):
        with pytest.raises(PolicyError, match="init_from"):
            train(tiny(tmp_path, init_from=str(first.folder), **misfit), quiet())
    assert sorted((tmp_path / "runs").iterdir()) == folders  # a refused training leaves nothing behind


def test_an_interrupted_training_leaves_its_model(tmp_path):
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job inherits an ignored one
    from stable_baselines3.common.callbacks import BaseCallback

    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps >= 100:
                signal.raise_signal(signal.SIGINT)
            return True

    with pytest.raises(KeyboardInterrupt):
        train(tiny(tmp_path), quiet(), callbacks=[Interrupt()])
    assert signal.signal(signal.SIGINT, handler) is signal.default_int_handler  # as it was
    assert load_policy(tmp_path / "runs" / "ddpg_3v1o_1").num_timesteps == 102


def test_workers_train_too(tmp_path):
    assert train(tiny(tmp_path, num_cpus=2, total_timesteps=120, eval_freq=0), quiet()).model.num_timesteps == 120


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": "abacus"}, "device = 'abacus'"),
        ({"device": "meta"}, "device = 'meta'"),
        ({"output_dir": "/dev/null/runs"}, "output_dir = /dev/null/runs"),
        ({"n_anchors": 5}, "do not fit an observation of"),
        ({"buffer_size": 10**12}, "buffer_size = 1000000000000"),
        ({"n_vehicles": 500}, "n_vehicles = 500"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(changes, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        train(tiny(tmp_path, **changes), quiet())
    assert "\n" not in str(error.value)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("expert", [None, "orca"])
def test_in_training_the_filter_keeps_the_tasks_separations_and_the_reward_counts_wider_ones(tmp_path, expert):
    changes = {"n_vehicles": 6, "n_obstacles": 0, "arena": 0.3, "safety_filter": "voronoi", "separation_scale": 1.15}
    changes |= {"time_step_scale": 1.0, "action_repeat": 2, "flock_sizes": None, "expert": expert, "expert_fraction": 0.0}
    env = make_training_env(tiny(tmp_path, **changes))
    env.reset()
    rng, nearest, penalized = np.random.default_rng(0), [], []
    for _ in range(100):
        turns = rng.uniform(-np.pi, np.pi, env.num_envs)
        infos = env.step(np.stack((np.full(env.num_envs, 0.15), turns), axis=-1).astype(np.float32))[-1]
        nearest += [info["metrics"]["nearest_neighbor"] for info in infos]
        penalized += [info["reward_terms"]["connectivity"] < 0 for info in infos]
    env.close()
    assert 0.1 <= min(nearest) < 0.115
    assert any(penalized)


@pytest.mark.parametrize(
    ("slip", "limits"), [(0.05, "; the safety filter guarantees no separation with actuators.slip = 0.05"), (0.0, "")]
)
def test_the_first_line_names_what_ends_the_guarantee_of_the_filter(tmp_path, slip, limits):
    console = Console(file=io.StringIO(), width=1000)
    result = train(tiny(tmp_path, total_timesteps=60, eval_freq=0, n_test_episodes=1, **{"actuators.slip": slip}), console)
    first = console.file.getvalue().splitlines()[0]
    assert first.endswith(f"{result.folder}{limits}")


def test_the_first_line_names_what_is_drawn(tmp_path):
    console = Console(file=io.StringIO(), width=1000)
    ranges = {"actuators.speed_lag": (0.0, 0.3), "sensors.dropout": (0, 0.1)}
    train(tiny(tmp_path, total_timesteps=60, eval_freq=0, n_test_episodes=1, randomization=ranges), console)
    first = console.file.getvalue().splitlines()[0]
    assert "; drawn for each flock and episode: actuators.speed_lag 0 to 0.3, sensors.dropout 0 to 0.1" in first
