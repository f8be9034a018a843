"""The speed of training and of evaluation, one core."""

import time

import numpy as np
import pytest
from rich.console import Console
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import configure

from sb3_flock import CompactReplayBuffer, FlockCNN, FlockDDPG, FlockPolicy, evaluate, load_policy, make_vec_env, train
from sb3_flock.config.training import TrainingConfig
from sb3_flock.rl.registry import policy_kwargs
from sb3_flock.serialization.yaml_io import load_config
from tests.benchmarks.conftest import POLICY
from tests.helpers import PlainCNN

CONFIG = load_config(TrainingConfig, overrides={"n_vehicles": 5, "n_obstacles": 2})
UPDATES = 25


KINDS = {
    "sb3": (DDPG, PlainCNN, False, None),  # SB3's DDPG, torch's convolutions and Adam, SB3's buffer
    "sb3 with FlockCNN and fused Adam": (DDPG, FlockCNN, True, None),  # --algo ddpg-sb3
    "sb3_flock": (FlockDDPG, FlockCNN, True, CompactReplayBuffer),  # --algo ddpg
}


def untrained_model(kind, env):
    """A model with a filled buffer and no update yet."""
    algorithm, extractor, fused, buffer = KINDS[kind]
    model = algorithm(
        FlockPolicy,
        env,
        batch_size=CONFIG.algorithm.batch_size,
        buffer_size=10_000,
        learning_starts=10_000,
        replay_buffer_class=buffer,
        policy_kwargs={
            **policy_kwargs(CONFIG), "features_extractor_class": extractor, "optimizer_kwargs": {"fused": fused},
        },
        seed=0,
        device="cpu",
    )  # fmt: skip
    model.set_logger(configure(None, []))
    model.learn(3_200)
    return model


def test_updates(benchmark):
    """Rounds of updates of each kind in turn, so that other load of the machine affects all of them."""
    env = make_vec_env(CONFIG.training_scenarios()[0], 8, seed=0)
    models = {kind: untrained_model(kind, env) for kind in KINDS}
    seconds = {kind: [] for kind in KINDS}

    def one_round():
        for kind, model in models.items():
            start = time.perf_counter()
            model.train(UPDATES, CONFIG.algorithm.batch_size)
            seconds[kind].append(time.perf_counter() - start)

    benchmark.pedantic(one_round, rounds=20, warmup_rounds=2)
    times = {kind: np.array(spent[2:]) for kind, spent in seconds.items()}
    if benchmark.disabled:
        return
    for kind, spent in times.items():
        ratios = np.percentile(times["sb3"] / spent, [10, 50, 90])
        benchmark.extra_info[kind] = {
            "updates_per_second": UPDATES / float(np.median(spent)),
            "times_sb3": dict(zip(("p10", "median", "p90"), ratios.tolist(), strict=True)),
        }


def test_profile_of_a_training(benchmark, tmp_path, monkeypatch):
    """Shares of the time of ``sb3-flock train``, with its frequency of evaluations."""
    spent = {}

    def timed(owner, name, key):
        original = getattr(owner, name)

        def call(*args, **kwargs):
            start = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                spent[key] = spent.get(key, 0.0) + time.perf_counter() - start

        monkeypatch.setattr(owner, name, call)

    from sb3_flock.envs.vec_env import ParameterSharingVecEnv
    from sb3_flock.training.eval_callback import FlockEvalCallback

    timed(FlockDDPG, "train", "updates")
    timed(CompactReplayBuffer, "sample", "updates: sampling the replay buffer")
    timed(ParameterSharingVecEnv, "step_wait", "environment, SuperSuit included")
    timed(FlockEvalCallback, "_evaluate", "evaluation")
    timed(CompactReplayBuffer, "add", "replay buffer, storing")
    short = 20 * 32 if benchmark.disabled else 20_000
    config = CONFIG.replace(total_timesteps=short, output_dir=str(tmp_path), eval_freq=10_000, save_freq=0)

    def run():
        spent.clear()
        train(config, Console(quiet=True))

    benchmark.pedantic(run, rounds=1)
    if benchmark.disabled:
        return
    whole = benchmark.stats.stats.median
    benchmark.extra_info |= {"transitions_per_second": short / whole}
    benchmark.extra_info |= {f"share of {key}": seconds / whole for key, seconds in spent.items()}


def test_a_thousand_episodes(benchmark):
    policy = load_policy(POLICY)
    episodes = 2 if benchmark.disabled else 1000
    benchmark.pedantic(evaluate, (policy,), {"episodes": episodes}, rounds=3, warmup_rounds=0)


@pytest.mark.parametrize("name", ["iddpg", "maddpg", "sbx"])
def test_peers_in_training(benchmark, peer, tmp_path, name):
    """The package and a peer in turn: 5 agents, 8 flocks, the same batch and update-to-data ratio; see the peer's script."""
    seconds, updates = [], []
    config = CONFIG.replace(
        total_timesteps=16_000, output_dir=str(tmp_path), eval_freq=0, save_freq=0,
        train_env=CONFIG.train_env.replace(flock_sizes=5),
        algorithm=CONFIG.algorithm.replace(learning_starts=200),
    )  # fmt: skip

    def run():
        start = time.perf_counter()
        updates.append(train(config, Console(quiet=True)).model._n_updates)
        seconds.append(time.perf_counter() - start)

    benchmark.pedantic(run, rounds=1)
    result = peer(
        "training.py", name, "--vehicles", 5, "--flocks", 8, "--batch", config.algorithm.batch_size,
        "--utd-ratio", config.algorithm.utd_ratio, "--seconds", 60,
    )  # fmt: skip
    own = {
        "env_steps_per_second": config.total_timesteps / seconds[-1],
        "updates_per_second": updates[-1] / seconds[-1],
    }
    benchmark.extra_info |= {"sb3_flock": own, name: result}
    for key, value in own.items():
        benchmark.extra_info[f"times_{name}: {key}"] = value / result[key]
