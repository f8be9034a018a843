"""A parallel env whose agents die and join by a script."""

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

LIVES = {"a": (0, 3, "termination"), "b": (0, 6, "truncation"), "c": (2, 5, "termination"), "d": (0, 6, "truncation")}
"""For each agent the step after which it is there, its last step, and how it ends."""


class Scripted(ParallelEnv):
    """An agent observes its number and the step, both from 1, and its last action; its reward is ten times its number.

    Each reset says in the infos who neighbors whom, as every step does, with other neighbors.
    """

    metadata = {"name": "scripted"}  # noqa: RUF012 - PettingZoo's form
    render_mode = None

    def __init__(self, lives=LIVES):
        self.lives, self.possible_agents, self.agents = lives, list(lives), []
        self.spaces = spaces.Box(-1.0, 100.0, (3,), np.float32), spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.received, self.buffer = [], {name: np.zeros(3, np.float32) for name in lives}

    def observation_space(self, agent):
        return self.spaces[0]

    def action_space(self, agent):
        return self.spaces[1]

    def reset(self, seed=None, options=None):
        self.steps, self.received = 0, []
        self.agents = [name for name, (start, *_) in self.lives.items() if start == 0]
        return self.observe({}), {name: {"neighbors": [3], "start": True} for name in self.agents}

    def step(self, actions):
        acting, self.steps = self.agents, self.steps + 1
        self.received.append(actions)
        ends = [name for name in acting if self.lives[name][1] == self.steps]
        self.agents = [name for name in acting if name not in ends]
        self.agents += [name for name, (start, *_) in self.lives.items() if start == self.steps]
        return (
            self.observe(actions, {*acting, *self.agents}),
            {name: 10.0 * self.number(name) for name in acting},
            {name: name in ends and self.lives[name][2] == "termination" for name in acting},
            {name: name in ends and self.lives[name][2] == "truncation" for name in acting},
            {name: {"neighbors": [0]} for name in acting},
        )

    def number(self, name):
        return self.possible_agents.index(name) + 1

    def observe(self, actions, names=None):
        """Observations in arrays that the env uses again and again."""
        for name in names or self.agents:
            self.buffer[name][:] = self.number(name), self.steps + 1, actions.get(name, [0.0])[0]
        return {name: self.buffer[name] for name in names or self.agents}

    def state_dict(self):
        return {
            "steps": self.steps,
            "agents": list(self.agents),
            "buffer": {name: list(b) for name, b in self.buffer.items()},
        }

    def load_state_dict(self, state):
        self.steps, self.agents = state["steps"], list(state["agents"])
        self.buffer = {name: np.array(numbers, np.float32) for name, numbers in state["buffer"].items()}
