"""How fast other libraries train DDPG: transitions and updates per second, simulation included, on one CPU thread.

Run by the Python of the peers' own environment (requirements.txt beside this file, and sb3_flock itself); prints one line of
JSON::

    python training.py iddpg --vehicles 5 --flocks 8 --batch 128 --utd-ratio 0.2 --seconds 60

``iddpg`` and ``maddpg`` are BenchMARL's, on its VMAS flocking task: DDPG with one policy for all agents, whose critic sees
one agent or all of them. ``sbx`` is the DDPG of SBX (JAX) on sb3_flock's own vector env. A transition is one step of one
agent, as in sb3_flock. All networks are multilayer perceptrons of the same width, as SBX's DDPG has no convolutions.
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
    model = DDPG(
        "MlpPolicy",  # flattens the observation
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
        policy_kwargs={"net_arch": NET_ARCH},
        seed=0,
    )
    with contextlib.suppress(Done):
        model.learn(10**9, callback=Watch())
    env.close()
    return {
        "batch": args.batch,
        "observation_size": int(np.prod(scenario.observation_shape)),
        "network": f"MLP {NET_ARCH} of the flattened observation, no convolutions, one critic",
        "versions": {name: version(name) for name in ("sbx-rl", "jax", "flax", "stable-baselines3", "sb3_flock")},
    }


def main() -> None:
    """Train with the peer that the command line names."""
    parser = argparse.ArgumentParser(description="Speed of another library's DDPG, as one line of JSON.")
    parser.add_argument("peer", choices=("iddpg", "maddpg", "sbx"))
    parser.add_argument("--vehicles", type=int, default=5)
    parser.add_argument("--flocks", type=int, default=8)
    parser.add_argument("--batch", type=int, default=128, help="transitions in a minibatch")
    parser.add_argument("--utd-ratio", type=float, default=0.2, help="updates for each transition")
    parser.add_argument("--seconds", type=float, default=60.0)
    args = parser.parse_args()

    # One thread each for torch and for XLA, whose thread pools are as large as NPROC says.
    os.environ.update(OMP_NUM_THREADS="1", NPROC="1", JAX_PLATFORMS="cpu")
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    stopwatch = Stopwatch(args.seconds)
    with contextlib.redirect_stdout(sys.stderr):  # BenchMARL prints that it was stopped
        setup = train_sbx(args, stopwatch) if args.peer == "sbx" else train_benchmarl(args.peer, args, stopwatch)
    print(json.dumps({"peer": args.peer, "flocks": args.flocks, "vehicles": args.vehicles, **setup, **stopwatch.result}))


if __name__ == "__main__":
    main()
