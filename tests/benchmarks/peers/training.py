"""How fast other libraries train DDPG: transitions and updates per second, simulation included, on one CPU thread.

Run by the Python of the peers' own environment (requirements.txt beside this file, and sb3_flock itself); prints one line of
JSON::

    python training.py iddpg --vehicles 5 --flocks 8 --batch 128 --utd-ratio 0.2 --seconds 60
    python training.py updates --config configs/flock.yaml --batch 256

``iddpg`` and ``maddpg`` are BenchMARL's, on its VMAS flocking task: DDPG with one policy for all agents, whose critic sees
one agent or all of them. ``sbx`` is the DDPG of SBX (JAX) on sb3_flock's own vector env. A transition is one step of one
agent, as in sb3_flock. These networks are multilayer perceptrons of the same width, as SBX's DDPG has no convolutions.

``sbx-cnn`` is SBX's DDPG with sb3_flock's networks (flax_networks.py), ``sbx-patches`` the same with convolutions as matrix
products. ``updates`` measures the updates of both alone, and sb3_flock's in turn, in the same process.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

N_OBSTACLES = 2
EPISODE = 200
NET_ARCH = [256, 64]
BUFFER = 250_000
"""Transitions that the replay buffer holds."""
LEARNING_RATE = 5e-4
GAMMA = 0.98
ROUND = 20
"""Vector steps between BenchMARL's rounds of updates: BenchMARL collects many and then updates many times."""
WARM_UP = 1600
"""Transitions before the clock starts, with updates; SBX compiles in this time."""
UPDATES = 25
"""Updates in each round of ``updates``."""
ROUNDS = 30


class Done(Exception):  # noqa: N818 - no error
    """The time is over."""


class Stopwatch:
    """Starts at the end of the warm-up and raises :class:`Done` after the given seconds."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.start: tuple[float, float, int, int] | None = None
        self.result: dict[str, float] = {}

    def check(self, transitions: int, updates: int) -> None:
        """Compare the clock with the counts since the start of the training; called between rounds of updates."""
        now, cpu = time.perf_counter(), time.process_time()
        if self.start is None:
            if transitions >= WARM_UP:
                self.start = (now, cpu, transitions, updates)
            return
        elapsed = now - self.start[0]
        if elapsed >= self.seconds:
            self.result = {
                "seconds": round(elapsed, 2),
                "cores_used": round((cpu - self.start[1]) / elapsed, 2),
                "env_steps_per_second": round((transitions - self.start[2]) / elapsed, 1),
                "updates_per_second": round((updates - self.start[3]) / elapsed, 2),
            }
            raise Done


def train_benchmarl(algorithm: str, args: argparse.Namespace, stopwatch: Stopwatch) -> dict[str, Any]:
    """BenchMARL's IDDPG or MADDPG on VMAS's flocking; returns the description of the setup."""
    import torch
    from benchmarl.algorithms import IddpgConfig, MaddpgConfig
    from benchmarl.environments import VmasTask
    from benchmarl.experiment import Callback, Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    torch.set_num_threads(1)

    class Count(Callback):
        """Counts optimizer steps, and frames after their updates."""

        def __init__(self) -> None:
            super().__init__()
            self.updates = 0

        def on_train_step(self, batch: Any, group: str) -> None:
            self.updates += 1

        def on_train_end(self, training_td: Any, group: str) -> None:
            stopwatch.check(self.experiment.total_frames * args.vehicles, self.updates)

    # BenchMARL counts in frames; a frame is a step of one flock and holds a transition of every agent in it. A round
    # collects ROUND vector steps, ROUND * flocks frames, and updates `utd_ratio` times for each of their transitions.
    # A batch has as many frames as hold `batch` transitions.
    frames_per_round = ROUND * args.flocks
    frames_per_batch = -(-args.batch // args.vehicles)
    config = ExperimentConfig.get_from_yaml()
    config.off_policy_n_envs_per_worker = args.flocks
    config.off_policy_collected_frames_per_batch = frames_per_round
    config.off_policy_n_optimizer_steps = max(1, round(args.utd_ratio * frames_per_round * args.vehicles))
    config.off_policy_train_batch_size = frames_per_batch
    config.off_policy_memory_size = BUFFER // args.vehicles
    config.max_n_frames = 10**9
    config.share_policy_params = True
    config.lr, config.gamma = LEARNING_RATE, GAMMA
    config.evaluation = config.render = config.create_json = False
    config.loggers = []
    task = VmasTask.FLOCKING.get_from_yaml()
    task.config.update(n_agents=args.vehicles, n_obstacles=N_OBSTACLES, max_steps=EPISODE)
    model = MlpConfig.get_from_yaml()
    model.num_cells, model.activation_class = NET_ARCH, torch.nn.ReLU

    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        experiment = Experiment(
            task=task,
            algorithm_config={"iddpg": IddpgConfig, "maddpg": MaddpgConfig}[algorithm].get_from_yaml(),
            model_config=model,
            seed=0,
            config=config,
        )
        count = Count()  # added late, as an experiment pickles the callbacks that it is made with
        count.experiment = experiment
        experiment.callbacks.append(count)
        with contextlib.suppress(Done):
            experiment.run()
    inputs = "each agent's own observation and action" if algorithm == "iddpg" else "all agents' observations and actions"
    return {
        "batch": frames_per_batch * args.vehicles,
        "observation_size": experiment.observation_spec["agents", "observation"].shape[-1],
        "network": f"MLP {NET_ARCH} of VMAS's observation, shared policy, one shared critic of {inputs}",
        "versions": {name: version(name) for name in ("benchmarl", "torchrl", "tensordict", "vmas", "torch")},
    }


def train_sbx(args: argparse.Namespace, stopwatch: Stopwatch) -> dict[str, Any]:
    """SBX's DDPG on sb3_flock's vector env; returns the description of the setup."""
    import numpy as np
    from sbx import DDPG
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    from sb3_flock import Scenario, make_vec_env

    class Watch(BaseCallback):
        """Reads the stopwatch between the updates and the next vector step."""

        def _on_step(self) -> bool:
            return True

        def _on_rollout_start(self) -> None:
            stopwatch.check(self.model.num_timesteps, self.model._n_updates)

    scenario = Scenario(n_vehicles=args.vehicles, n_obstacles=N_OBSTACLES, max_cycles=EPISODE)
    env = make_vec_env(scenario, n_flocks=args.flocks, seed=0)
    if args.peer != "sbx":
        from flax_networks import FlaxFlockPolicy

        network = our_config(args).network
        policy, policy_kwargs = FlaxFlockPolicy, {"network": network, "by_patches": args.peer == "sbx-patches"}
        networks = f"sb3_flock's: convolutions of {network.channels} channels, {network.n_critics} critics"
    else:
        policy, policy_kwargs = "MlpPolicy", {"net_arch": NET_ARCH}  # flattens the observation
        networks = f"MLP {NET_ARCH} of the flattened observation, no convolutions, one critic"
    model = DDPG(
        policy,
        env,
        learning_rate=LEARNING_RATE,
        qf_learning_rate=LEARNING_RATE,
        gamma=GAMMA,
        buffer_size=BUFFER,
        learning_starts=WARM_UP // 2,
        batch_size=args.batch,
        train_freq=1,
        gradient_steps=max(1, round(args.utd_ratio * env.num_envs)),  # a vector step has a transition of every slot
        action_noise=NormalActionNoise(np.zeros(2), np.full(2, 0.3)),
        policy_kwargs=policy_kwargs,
        seed=0,
    )
    with contextlib.suppress(Done):
        model.learn(10**9, callback=Watch())
    env.close()
    return {
        "batch": args.batch,
        "observation_size": int(np.prod(scenario.observation_shape)),
        "network": networks,
        "versions": {name: version(name) for name in ("sbx-rl", "jax", "flax", "stable-baselines3", "sb3_flock")},
    }


def our_config(args: argparse.Namespace) -> Any:
    """sb3_flock's training config that the command line names, whose networks SBX has, too."""
    from sb3_flock import TrainingConfig
    from sb3_flock.serialization.yaml_io import load_config

    overrides = {"n_vehicles": args.vehicles, "n_obstacles": N_OBSTACLES, "final_init": None, "bc_coef": 0.0}
    return load_config(TrainingConfig, args.config, overrides)


def measure_updates(args: argparse.Namespace) -> dict[str, Any]:
    """Rounds of updates by SBX's DDPG and by sb3_flock's in turn; both start at the same weights, which is checked."""
    import numpy as np
    from flax_networks import FlaxFlockPolicy, assert_twins
    from sbx import DDPG
    from stable_baselines3.common.logger import configure

    from sb3_flock import make_vec_env
    from sb3_flock.rl.registry import build_model

    config = our_config(args)
    config = config.replace(algorithm=config.algorithm.replace(buffer_size=10_000, learning_starts=10_000))
    env = make_vec_env(config.training_scenarios()[0], args.flocks, seed=0)
    algorithm = config.algorithm
    models = {"sb3_flock": build_model(config, env)}
    for name, by_patches in (("sbx-cnn", False), ("sbx-patches", True)):
        models[name] = DDPG(
            FlaxFlockPolicy,
            env,
            learning_rate=algorithm.learning_rate,
            qf_learning_rate=algorithm.learning_rate,
            gamma=algorithm.gamma,
            buffer_size=algorithm.buffer_size,
            learning_starts=algorithm.learning_starts,
            policy_kwargs={"network": config.network, "by_patches": by_patches},
            seed=0,
        )
    for name, model in models.items():
        model.set_logger(configure(None, []))
        model.learn(3_200)
        if name != "sb3_flock":
            model.policy.take_weights(models["sb3_flock"])
            assert_twins(models["sb3_flock"], model, model.replay_buffer.sample(64))

    wall: dict[str, list[float]] = {name: [] for name in models}
    cpu: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(ROUNDS):
        for name, model in models.items():
            before = time.perf_counter(), time.process_time()
            model.train(UPDATES, args.batch)
            wall[name].append(time.perf_counter() - before[0])
            cpu[name].append(time.process_time() - before[1])
    env.close()
    measured: dict[str, Any] = {
        name: {
            "updates_per_second": round(UPDATES / float(np.median(seconds[2:])), 1),  # the first rounds compile
            "cores_used": round(sum(cpu[name][2:]) / sum(seconds[2:]), 2),
        }
        for name, seconds in wall.items()
    }
    for name in ("sbx-cnn", "sbx-patches"):
        ratios = np.percentile(np.array(wall[name][2:]) / wall["sb3_flock"][2:], [10, 50, 90])
        measured[f"times_{name}"] = dict(zip(("p10", "median", "p90"), ratios.round(2).tolist(), strict=True))
    return {
        "batch": args.batch,
        "observation": list(env.observation_space.shape),
        "channels": list(config.network.channels),
        **measured,
        "versions": {name: version(name) for name in ("sbx-rl", "jax", "flax", "stable-baselines3", "sb3_flock")},
    }


def main() -> None:
    """Train with the peer that the command line names."""
    parser = argparse.ArgumentParser(description="Speed of another library's DDPG, as one line of JSON.")
    parser.add_argument("peer", choices=("iddpg", "maddpg", "sbx", "sbx-cnn", "sbx-patches", "updates"))
    parser.add_argument("--vehicles", type=int, default=5)
    parser.add_argument("--flocks", type=int, default=8)
    parser.add_argument("--batch", type=int, default=128, help="transitions in a minibatch")
    parser.add_argument("--utd-ratio", type=float, default=0.2, help="updates for each transition")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--config", type=Path, help="sb3_flock's training config whose networks sbx-* and updates have")
    args = parser.parse_args()

    # One thread each for torch and for XLA, whose thread pools are as large as NPROC says.
    os.environ.update(OMP_NUM_THREADS="1", NPROC="1", JAX_PLATFORMS="cpu")
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    stopwatch = Stopwatch(args.seconds)
    with contextlib.redirect_stdout(sys.stderr):  # BenchMARL prints that it was stopped
        if args.peer == "updates":
            setup = measure_updates(args)
        elif args.peer.startswith("sbx"):
            setup = train_sbx(args, stopwatch)
        else:
            setup = train_benchmarl(args.peer, args, stopwatch)
    print(json.dumps({"peer": args.peer, "flocks": args.flocks, "vehicles": args.vehicles, **setup, **stopwatch.result}))


if __name__ == "__main__":
    main()
