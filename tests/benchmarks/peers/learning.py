"""How well agents act after the same minutes of training, on tasks of other people: sb3_flock's parts beside BenchMARL.

Run by the Python of the peers' own environment (requirements.txt beside this file, and sb3_flock itself). The first form trains
and prints one line of JSON; the second one prints a table of such lines::

    OMP_NUM_THREADS=1 python learning.py train spread maddpg --seed 0 --minutes 5 >> lines
    python learning.py table learning.jsonl  # of the runs in docs/other_envs.md

``spread`` is MPE2's simple_spread with three agents, ``multiwalker`` PettingZoo's SISL multiwalker with three. ``iddpg`` and
``maddpg`` are BenchMARL's, with one policy for all agents, whose critic sees one agent or all of them. ``ddpg`` is SB3's DDPG and
``td3`` is ``FlockTD3``, each in ``flatten``'s vector env with the neighbor-inclusive reward and a ``CompactReplayBuffer``: every
agent is every other one's neighbor. All have the same networks, learning rate, discount, transitions in a minibatch, updates
for each transition, and one thread. Minutes are those of the processor, so that other work on the machine takes none away. What
else there is, such as exploration, has each library's default. The score is the mean return of an agent over episodes of the
unwrapped env, with the last policy and without exploration.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

NET_ARCH = [256, 256]
LEARNING_RATE = 5e-4
GAMMA = {"spread": 0.95, "multiwalker": 0.99}
BATCH = 258
"""Transitions in a minibatch: three for each frame of BenchMARL."""
UTD_RATIO = 0.2
COPIES = 10
N_AGENTS = 3
BUFFER = 300_000
TEST_EPISODES = 100
TEST_SEED = 10_000

Act = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]


def make_env(name: str) -> Any:
    """The PettingZoo parallel env."""
    if name == "spread":
        from mpe2 import simple_spread_v3

        return simple_spread_v3.parallel_env(N=N_AGENTS, continuous_actions=True)
    from pettingzoo.sisl import multiwalker_v9

    return multiwalker_v9.parallel_env(n_walkers=N_AGENTS)


def test(name: str, act: Act) -> float:
    """The mean return of an agent over the test episodes."""
    env, returns = make_env(name), []
    for episode in range(TEST_EPISODES):
        observations, _ = env.reset(seed=TEST_SEED + episode)
        total = 0.0
        while env.agents:
            observations, rewards, *_ = env.step(act(observations))
            total += sum(rewards.values()) / N_AGENTS
        returns.append(total)
    env.close()
    return float(np.mean(returns))


def train_ours(name: str, algorithm: str, seed: int, seconds: float) -> tuple[Act, dict[str, Any]]:
    """SB3's DDPG or FlockTD3 with parameter sharing and the mix."""
    from pettingzoo.utils import BaseParallelWrapper
    from stable_baselines3 import DDPG
    from stable_baselines3.common.callbacks import BaseCallback, CallbackList
    from stable_baselines3.common.noise import NormalActionNoise

    from sb3_flock import CompactReplayBuffer, FlockTD3, NeighborInclusiveReward, flatten

    class AllAreNeighbors(BaseParallelWrapper):
        """Every agent is every other one's neighbor."""

        def step(self, actions: Any) -> Any:
            *results, infos = super().step(actions)
            for agent, info in infos.items():
                info["neighbors"] = [i for i, other in enumerate(self.possible_agents) if other != agent]
            return (*results, infos)

    class Until(BaseCallback):
        """Ends the training after its time."""

        def _on_step(self) -> bool:
            return time.process_time() - started < seconds

    env = flatten(AllAreNeighbors(make_env(name)), n_copies=COPIES, seed=seed)
    n_actions = env.action_space.shape[0]
    model = {"ddpg": DDPG, "td3": FlockTD3}[algorithm](
        "MlpPolicy",
        env,
        learning_rate=LEARNING_RATE,
        gamma=GAMMA[name],
        batch_size=BATCH,
        buffer_size=BUFFER,
        learning_starts=5000,
        train_freq=1,
        gradient_steps=round(UTD_RATIO * env.num_envs),
        action_noise=NormalActionNoise(np.zeros(n_actions), np.full(n_actions, 0.2)),
        policy_kwargs={"net_arch": NET_ARCH},
        replay_buffer_class=CompactReplayBuffer,
        seed=seed,
    )
    started = time.process_time()
    model.learn(10**9, CallbackList([NeighborInclusiveReward(0.5), Until()]))
    counts = {"transitions": model.num_timesteps, "updates": model._n_updates}

    def act(observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        actions, _ = model.predict(np.stack(list(observations.values())), deterministic=True)
        return dict(zip(observations, actions, strict=True))

    return act, counts


def train_benchmarl(name: str, algorithm: str, seed: int, seconds: float) -> tuple[Act, dict[str, Any]]:
    """BenchMARL's IDDPG or MADDPG."""
    import torch
    from benchmarl.algorithms import IddpgConfig, MaddpgConfig
    from benchmarl.environments import PettingZooTask
    from benchmarl.environments.pettingzoo import common
    from benchmarl.experiment import Callback, Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig
    from tensordict import TensorDict
    from torchrl.envs import PettingZooWrapper
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    torch.set_num_threads(1)

    class Done(Exception):  # noqa: N818 - no error
        """The time is over."""

    class Until(Callback):
        """Ends the training after its time; counts optimizer steps."""

        updates = 0

        def on_train_step(self, batch: Any, group: str) -> None:
            self.updates += 1

        def on_train_end(self, training_td: Any, group: str) -> None:
            if time.process_time() - started >= seconds:
                raise Done

    config = ExperimentConfig.get_from_yaml()
    rounds = 600  # frames between rounds of updates
    config.off_policy_n_envs_per_worker = COPIES
    config.off_policy_collected_frames_per_batch = rounds
    config.off_policy_n_optimizer_steps = round(UTD_RATIO * rounds * N_AGENTS)
    config.off_policy_train_batch_size = BATCH // N_AGENTS
    config.off_policy_memory_size = BUFFER // N_AGENTS
    config.off_policy_init_random_frames = 5000 // N_AGENTS
    config.exploration_anneal_frames = 60_000
    config.max_n_frames = 10**9
    config.lr, config.gamma = LEARNING_RATE, GAMMA[name]
    config.share_policy_params = True
    config.evaluation = config.render = config.create_json = False
    config.loggers = []
    task = {"spread": PettingZooTask.SIMPLE_SPREAD, "multiwalker": PettingZooTask.MULTIWALKER}[name].get_from_yaml()

    def make_torchrl_env(seed: int | None, device: Any, return_state: bool, **others: Any) -> Any:
        return PettingZooWrapper(make_env(name), return_state=return_state, seed=seed, device=device)

    common.PettingZooEnv = make_torchrl_env  # torchrl's own looks for MPE in PettingZoo, which it has left for MPE2
    model = MlpConfig.get_from_yaml()
    model.num_cells, model.activation_class = NET_ARCH, torch.nn.ReLU
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        experiment = Experiment(
            task=task,
            algorithm_config={"iddpg": IddpgConfig, "maddpg": MaddpgConfig}[algorithm].get_from_yaml(),
            model_config=model,
            seed=seed,
            config=config,
        )
        until = Until()  # added late, as an experiment pickles the callbacks that it is made with
        until.experiment = experiment
        experiment.callbacks.append(until)
        started = time.process_time()
        with contextlib.suppress(Done):
            experiment.run()

    (group,) = experiment.group_map

    def act(observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        agents = TensorDict({"observation": torch.as_tensor(np.stack(list(observations.values())))}, [len(observations)])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = experiment.policy(TensorDict({group: agents}, []))[group, "action"].numpy()
        return dict(zip(observations, chosen, strict=True))

    return act, {"transitions": experiment.total_frames * N_AGENTS, "updates": until.updates}


def table(path: Path) -> str:
    """Interquartile means over seeds, with rliable's intervals."""
    from rliable import library, metrics

    scores: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    counts: dict[tuple[str, str], list[int]] = defaultdict(list)
    for line in path.read_text().splitlines():
        run = json.loads(line)
        scores[run["env"]][run["algorithm"]].append(run["score"])
        counts[run["env"], run["algorithm"]].append(run["transitions"])
    rows = [
        "| env | algorithm | seeds | return of an agent (IQM) | 95 % interval | transitions |",
        "|---|---|---|---|---|---|",
    ]
    for env, runs in scores.items():
        matrix = {name: np.array(values)[:, None] for name, values in runs.items()}
        points, intervals = library.get_interval_estimates(matrix, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=5000)
        for name in sorted(runs, key=lambda name: -points[name][0]):
            low, high = intervals[name].ravel()
            rows.append(
                f"| {env} | {name} | {len(runs[name])} | {points[name][0]:.2f} | {low:.2f} .. {high:.2f} | "
                f"{np.mean(counts[env, name]):,.0f} |"
            )
    return "\n".join(rows)


def main() -> None:
    """Train, or print the table."""
    parser = argparse.ArgumentParser(description="Learning beside BenchMARL, in the same minutes.")
    commands = parser.add_subparsers(dest="command", required=True)
    train = commands.add_parser("train")
    train.add_argument("env", choices=tuple(GAMMA))
    train.add_argument("algorithm", choices=("ddpg", "td3", "iddpg", "maddpg"))
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--minutes", type=float, default=5.0)
    commands.add_parser("table").add_argument("lines", type=Path)
    args = parser.parse_args()
    if args.command == "table":
        print(table(args.lines))
        return
    with contextlib.redirect_stdout(sys.stderr):
        trained_by = train_ours if args.algorithm in ("ddpg", "td3") else train_benchmarl
        act, counts = trained_by(args.env, args.algorithm, args.seed, args.minutes * 60)
        score = test(args.env, act)
    settings = {"env": args.env, "algorithm": args.algorithm, "seed": args.seed, "minutes": args.minutes}
    print(json.dumps({**settings, "score": round(score, 3), **counts}))


if __name__ == "__main__":
    main()
