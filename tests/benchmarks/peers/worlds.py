"""How fast other multi-agent simulators are: steps of their worlds on one CPU thread, observations and rewards included.

Run by the Python of the peers' own environment (requirements.txt beside this file); prints one line of JSON::

    python worlds.py vmas --flocks 64 --vehicles 5 --obstacles 2 --seconds 3
    python worlds.py mpe2 --vehicles 5 --seconds 3

``vmas`` is VMAS's own flocking scenario, all flocks in one batch of tensors; ``mpe2`` is MPE2's simple_spread, one world of
Python objects with as many landmarks as agents. Neither is the task of sb3_flock: bodies, sensors and rewards differ.
Actions are random and drawn beforehand; an episode has 200 steps, and its reset is part of the measurement.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from itertools import cycle
from typing import Any

EPISODE = 200
"""Steps of an episode, as in sb3_flock."""
DRAWS = 64
"""Random actions drawn beforehand for each agent, repeated over and over."""
SLICES = 5
WARM_UP = 0.2
"""Seconds of warm-up for each second measured."""


def vmas_world(flocks: int, vehicles: int, obstacles: int) -> tuple[Callable[[], None], int]:
    """One step of VMAS's flocking scenario, and the numbers one agent observes."""
    import torch
    import vmas

    torch.set_num_threads(1)
    env = vmas.make_env(
        scenario="flocking",
        num_envs=flocks,
        device="cpu",
        seed=0,
        max_steps=EPISODE,
        n_agents=vehicles,
        n_obstacles=obstacles,
    )
    actions = cycle([env.get_random_actions() for _ in range(DRAWS)])
    observation_size = env.reset()[0].shape[1]

    def step() -> None:
        _, _, dones, _ = env.step(next(actions))
        if dones[0]:  # the flocks start together, and only the time limit ends them
            env.reset()

    return step, observation_size


def mpe2_world(vehicles: int) -> tuple[Callable[[], None], int]:
    """One step of MPE2's simple_spread, and the numbers one agent observes."""
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=vehicles, max_cycles=EPISODE, continuous_actions=True)
    env.reset(seed=0)
    spaces = {agent: env.action_space(agent) for agent in env.agents}
    for i, space in enumerate(spaces.values()):
        space.seed(i)
    actions = cycle([{agent: space.sample() for agent, space in spaces.items()} for _ in range(DRAWS)])
    observation_size = env.observation_space(env.agents[0]).shape[0]

    def step() -> None:
        env.step(next(actions))
        if not env.agents:
            env.reset()

    return step, observation_size


def seconds_per_step(step: Callable[[], None], seconds: float) -> float:
    """Median over equal slices of the time measured, after a warm-up."""

    def run(duration: float) -> float:
        start, steps = time.perf_counter(), 0
        while (elapsed := time.perf_counter() - start) < duration:
            step()
            steps += 1
        return elapsed / steps

    run(WARM_UP * seconds)
    return statistics.median(run(seconds / SLICES) for _ in range(SLICES))


def main() -> None:
    """Measure the peer that the command line names."""
    parser = argparse.ArgumentParser(description="Speed of another simulator's world, as one line of JSON.")
    peers = parser.add_subparsers(dest="peer", required=True)
    for name in ("vmas", "mpe2"):
        peer = peers.add_parser(name)
        peer.add_argument("--vehicles", type=int, default=5)
        peer.add_argument("--seconds", type=float, default=3.0)
    peers.choices["vmas"].add_argument("--flocks", type=int, default=64)
    peers.choices["vmas"].add_argument("--obstacles", type=int, default=2)
    args = parser.parse_args()

    os.environ["OMP_NUM_THREADS"] = "1"
    if args.peer == "vmas":
        size: dict[str, Any] = {"flocks": args.flocks, "vehicles": args.vehicles, "obstacles": args.obstacles}
        step, observation_size = vmas_world(**size)
    else:
        size = {"flocks": 1, "vehicles": args.vehicles, "obstacles": 0}
        step, observation_size = mpe2_world(args.vehicles)
    duration = seconds_per_step(step, args.seconds)
    result = {
        "peer": args.peer,
        "version": version(args.peer),
        **size,
        "observation_size": observation_size,
        "vehicle_steps_per_second": round(size["flocks"] * size["vehicles"] / duration, 1),
        "seconds_per_step": duration,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
