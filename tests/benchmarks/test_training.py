"""The speed of training and of evaluation, one core."""

import time
from pathlib import Path
from typing import NamedTuple

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
from tests.helpers import PlainCNN, expert_vec_env

CONFIGS = Path(__file__).parents[2] / "configs"

CONFIG = load_config(TrainingConfig, overrides={"n_vehicles": 5, "n_obstacles": 2})
SHAPES = {"default": CONFIG, "flock": load_config(TrainingConfig, CONFIGS / "flock.yaml")}
"""The networks of the shipped policies: two convolutions of 3 channels, and one of 6 channels."""
UPDATES = 25


class Kind(NamedTuple):
    """A way to update a model."""

    algorithm: type = FlockDDPG
    extractor: type = FlockCNN
    is_fused: bool = True
    compiled: bool = True
    threads: int = 1
    """Threads of a compiled update; torch has one."""
    bc_coef: float = 0.0


STOCK = "sb3"
KINDS = {
    STOCK: Kind(DDPG, PlainCNN, is_fused=False),  # SB3's DDPG, torch's convolutions and Adam, SB3's buffer
    "sb3 with FlockCNN and fused Adam": Kind(DDPG),  # --algo ddpg-sb3
    "sb3_flock by torch": Kind(compiled=False),  # --algo ddpg without the fast extra
    "sb3_flock compiled": Kind(),  # --algo ddpg
    "sb3_flock compiled, bc_coef": Kind(bc_coef=10.0),
    "sb3_flock compiled, two threads": Kind(threads=2),
}


def untrained_model(kind, config, env):
    """A model with a filled buffer and no update yet."""
    own = {
        "replay_buffer_class": CompactReplayBuffer,
        "replay_buffer_kwargs": {"mirror_augmentation": True, "store_expert_actions": kind.bc_coef > 0},
        "compiled": kind.compiled,
        "bc_coef": kind.bc_coef,
        "update_threads": kind.threads,
    }
    model = kind.algorithm(
        FlockPolicy,
        env,
        buffer_size=10_000,
        learning_starts=10_000,
        policy_kwargs={
            **policy_kwargs(config), "features_extractor_class": kind.extractor, "optimizer_kwargs": {"fused": kind.is_fused},
        },
        seed=0,
        device="cpu",
        **(own if kind.algorithm is FlockDDPG else {}),
    )  # fmt: skip
    model.set_logger(configure(None, []))
    model.learn(3_200)
    return model


@pytest.mark.parametrize("batch_size", [128, 256])
@pytest.mark.parametrize("shape", SHAPES)
def test_updates(benchmark, shape, batch_size):
    """Rounds of updates of each kind in turn, so that other load of the machine affects all of them."""
    config = SHAPES[shape]
    scenario = config.training_scenarios()[0]
    env = make_vec_env(scenario, 8, seed=0)
    kinds = {name: kind for name, kind in KINDS.items() if config.algorithm.bc_coef or not kind.bc_coef}
    envs = {0.0: env} | ({10.0: expert_vec_env(scenario)} if config.algorithm.bc_coef else {})
    models = {name: untrained_model(kind, config, envs[kind.bc_coef]) for name, kind in kinds.items()}
    seconds = {name: [] for name in kinds}

    def one_round():
        for name, model in models.items():
            start = time.perf_counter()
            model.train(UPDATES, batch_size)
            seconds[name].append(time.perf_counter() - start)

    benchmark.pedantic(one_round, rounds=20, warmup_rounds=2)
    times = {name: np.array(spent[2:]) for name, spent in seconds.items()}
    if benchmark.disabled:
        return
    for name, spent in times.items():
        benchmark.extra_info[name] = {
            "updates_per_second": UPDATES / float(np.median(spent)),
            "times_sb3": _percentiles(times[STOCK] / spent),
        }


@pytest.mark.parametrize("batch_size", [128, 256])
@pytest.mark.parametrize("shape", SHAPES)
def test_products_of_an_update(benchmark, shape, batch_size):
    """The compiled update in one thread, and its matrix products alone, in turn: what limits it."""
    pytest.importorskip("numba")
    from tests.benchmarks.products import flops, memory_of, products_of, run_products

    config = SHAPES[shape]
    model = untrained_model(Kind(), config, make_vec_env(config.training_scenarios()[0], 8, seed=0))
    model.train(1, batch_size)
    products = products_of(model, batch_size)
    memory = memory_of(products)
    seconds = {"update": [], "products": []}

    def one_round():
        start = time.perf_counter()
        model.train(UPDATES, batch_size)
        middle = time.perf_counter()
        run_products(products, UPDATES, *memory)
        seconds["update"].append((middle - start) / UPDATES)
        seconds["products"].append((time.perf_counter() - middle) / UPDATES)

    benchmark.pedantic(one_round, rounds=20, warmup_rounds=2)
    if benchmark.disabled:
        return
    update, alone = (np.array(seconds[name][2:]) for name in ("update", "products"))
    benchmark.extra_info |= {
        "MFLOP of the products": flops(products) / 1e6,
        "milliseconds": {"update": 1e3 * float(np.median(update)), "products": 1e3 * float(np.median(alone))},
        "share of the products": _percentiles(alone / update),
    }


def _percentiles(ratios):
    return dict(zip(("p10", "median", "p90"), np.percentile(ratios, [10, 50, 90]).tolist(), strict=True))


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


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["iddpg", "maddpg", "sbx", "sbx-cnn", "sbx-patches"])
def test_peers_in_training(benchmark, peer, tmp_path, name):
    """The package and a peer in turn: 5 agents, 8 flocks, the same batch and update-to-data ratio; see the peer's script."""
    own, others = [], []
    config = CONFIG.replace(
        total_timesteps=8_000, eval_freq=0, save_freq=0, train_env=CONFIG.train_env.replace(flock_sizes=5),
        algorithm=CONFIG.algorithm.replace(learning_starts=200),
    )  # fmt: skip

    def one_round():
        start = time.perf_counter()
        result = train(config.replace(output_dir=str(tmp_path / str(len(own)))), Console(quiet=True))
        seconds = time.perf_counter() - start
        own.append({"env_steps_per_second": 8_000 / seconds, "updates_per_second": result.model._n_updates / seconds})
        words = ("--batch", config.algorithm.batch_size, "--utd-ratio", config.algorithm.utd_ratio, "--seconds", 20)
        others.append(peer("training.py", name, "--vehicles", 5, "--flocks", 8, *words))

    benchmark.pedantic(one_round, rounds=3, warmup_rounds=1)
    benchmark.extra_info |= {"sb3_flock": own[1:], name: others[1:]}
    for key in own[0]:
        ratios = [ours[key] / theirs[key] for ours, theirs in zip(own[1:], others[1:], strict=True)]
        benchmark.extra_info[f"times_{name}: {key}"] = sorted(ratios)


@pytest.mark.parametrize("batch_size", [128, 256])
@pytest.mark.parametrize("shape", SHAPES)
def test_peers_in_updates(benchmark, peer, shape, batch_size):
    """SBX with the same networks and the compiled update in turn, in one process of one thread; see the peer's script."""
    words = ["updates", "--batch", batch_size]
    if shape != "default":
        words += ["--config", CONFIGS / "flock.yaml"]
    benchmark.extra_info |= benchmark.pedantic(peer, ("training.py", *words), rounds=1)
