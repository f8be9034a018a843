"""Groups of agents with different spaces, each with a model of its own, in the same episodes."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from mpe2 import simple_tag_v3
from stable_baselines3 import A2C, DDPG, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from sb3_flock import NeighborInclusiveReward, flatten, flatten_groups, learn_groups
from sb3_flock.settings import RunError, SettingsError
from tests.envs.scripted import Scripted

LIVES = {
    "big_0": (0, 3, "termination"),
    "small_0": (0, 6, "truncation"),
    "big_1": (0, 6, "truncation"),
    "small_1": (2, 5, "termination"),
}
GROUPS = {"big": ["big_0", "big_1"], "small": ["small_0", "small_1"]}


class TwoKinds(Scripted):
    """The scripted env with two kinds of agents; the small ones observe two numbers and have one action.

    Each agent's neighbors are all others.
    """

    def __init__(self):
        super().__init__(LIVES)
        self.all_received = []

    def observation_space(self, agent):
        return spaces.Box(-1.0, 100.0, (3 if "big" in agent else 2,), np.float32)

    def action_space(self, agent):
        return spaces.Box(-1.0, 1.0, (2 if "big" in agent else 1,), np.float32)

    def step(self, actions):
        self.all_received.append({name: action.copy() for name, action in actions.items()})
        *parts, infos = super().step(actions)
        others = {name: [i for i, other in enumerate(self.possible_agents) if other != name] for name in infos}
        return *parts, {name: {"neighbors": others[name]} for name in infos}

    def observe(self, actions, names=None):
        observed = super().observe(actions, names)
        return {name: value[:3] if "big" in name else value[:2] for name, value in observed.items()}


class Record(BaseCallback):
    """What a model's env returned in each step."""

    def __init__(self):
        super().__init__()
        self.steps = []

    def _on_step(self):
        names = ("new_obs", "rewards", "dones", "infos", "actions", "clipped_actions")
        self.steps.append({name: self.locals[name] for name in names if name in self.locals})
        return True


def models_of(envs, **kinds):
    return {
        name: kinds.get(name, PPO)(
            "MlpPolicy", env, seed=0, device="cpu", **({"n_steps": 6, "batch_size": 12} if name not in kinds else {})
        )
        for name, env in envs.items()
    }


def test_groups_act_in_the_same_episodes_and_see_their_own_part():
    envs = flatten_groups(TwoKinds(), n_copies=2, seed=0)
    assert {name: env.num_envs for name, env in envs.items()} == {"big": 4, "small": 4}
    assert envs["big"].observation_space.shape == (3,)
    assert envs["small"].action_space.shape == (1,)
    records = {name: Record() for name in envs}
    learn_groups(models_of(envs), 12, records)
    for name, record in records.items():
        assert len(record.steps) == 12
        for index, step in enumerate(record.steps):
            number = index % 6 + 1
            alive = [LIVES[agent][0] < number <= LIVES[agent][1] for agent in GROUPS[name]] * 2
            ends = [LIVES[agent][1] == number for agent in GROUPS[name]] * 2
            assert [info["alive"] for info in step["infos"]] == alive
            assert step["dones"].tolist() == ends
            numbers = np.array([list(LIVES).index(agent) + 1 for agent in GROUPS[name]] * 2)
            cut = [bool(info.get("TimeLimit.truncated")) for info in step["infos"]]  # to their rewards PPO adds a value
            np.testing.assert_array_equal(np.where(cut, 0, step["rewards"]), np.where(cut, 0, 10 * numbers * alive))
            for slot, info in enumerate(step["infos"]):
                if alive[slot]:
                    assert info["neighbors"] == [1 - slot % 2]  # in the own group, as an index into it
                if ends[slot]:
                    np.testing.assert_array_equal(info["terminal_observation"][:2], [numbers[slot], number + 1])
                    assert info["TimeLimit.truncated"] == (LIVES[GROUPS[name][slot % 2]][2] == "truncation")
    # the env got what the models did, of both groups at once
    received = envs["big"].get_attr("joint")[0].env.all_received
    assert len(received) == 12
    for index, actions in enumerate(received):
        for name, record in records.items():
            given = record.steps[index].get("clipped_actions", record.steps[index]["actions"])
            for slot, agent in enumerate(GROUPS[name]):
                if agent in actions:
                    np.testing.assert_array_equal(actions[agent], given[slot])


def test_an_env_of_groups_needs_no_metadata(monkeypatch):
    monkeypatch.delattr(Scripted, "metadata")
    monkeypatch.delattr(Scripted, "render_mode")
    envs = flatten_groups(TwoKinds(), seed=0)
    assert {name: env.render_mode for name, env in envs.items()} == {"big": None, "small": None}
    assert all(isinstance(env.metadata, dict) for env in envs.values())


def test_one_group_learns_as_the_flattened_env_does():
    """All agents in one group: the same bits as flatten and learn."""
    parameters = []
    for grouped in (True, False):
        envs = flatten_groups(Scripted(), {"all": list("abcd")}, seed=3) if grouped else {"all": flatten(Scripted(), seed=3)}
        (model,) = models_of(envs).values()
        if grouped:
            learn_groups({"all": model}, 24)
        else:
            model.learn(24 * 4)
        parameters.append(th.cat([parameter.flatten() for parameter in model.policy.parameters()]))
    assert th.equal(*parameters)


@pytest.mark.parametrize("kinds", [{}, {"adversary": DDPG}, {"adversary": SAC, "agent": A2C}])
def test_trainings_repeat(kinds):
    """Predators and prey of MPE2, which differ in their observations; with rollouts of other lengths one goes on acting."""
    ends = []
    for _ in range(2):
        envs = flatten_groups(simple_tag_v3.parallel_env(max_cycles=10, continuous_actions=True), n_copies=2, seed=1)
        models = models_of({name: VecMonitor(env) for name, env in envs.items()}, **kinds)
        learn_groups(models, 40)
        assert {name: model.num_timesteps // model.n_envs for name, model in models.items()}["agent"] >= 40
        ends.append(th.cat([value.flatten() for model in models.values() for value in model.policy.parameters()]))
        assert len(models["agent"].ep_info_buffer) >= 8
    assert th.equal(*ends)
    assert th.isfinite(ends[0]).all()


def test_a_training_goes_on_and_takes_a_callback_for_each_group():
    envs = flatten_groups(TwoKinds(), seed=0)
    models = models_of(envs)
    learn_groups(models, 7, {"big": NeighborInclusiveReward(0.5)})  # rollouts of 6 steps: 12 are taken
    assert {model.num_timesteps for model in models.values()} == {24}
    learn_groups(models, 6, reset_num_timesteps=False)
    assert {model.num_timesteps for model in models.values()} == {36}


class Fails(BaseCallback):
    def _on_step(self):
        if self.num_timesteps > 10:
            raise FloatingPointError("the loss is not finite")
        return True


def test_an_error_in_one_group_ends_all():
    envs = flatten_groups(TwoKinds(), seed=0)
    models = models_of(envs)
    with pytest.raises(FloatingPointError, match="the loss is not finite"):
        learn_groups(models, 1000, {"small": Fails()})
    learn_groups(models, 6)  # and the envs can be used again


def test_a_group_cannot_step_alone():
    envs = flatten_groups(TwoKinds(), seed=0)
    envs["big"].reset()
    with pytest.raises(RunError, match="the group big cannot step alone: learn_groups"):
        envs["big"].step(np.zeros((2, 2), np.float32))


def test_what_does_not_fit_is_one_line():
    with pytest.raises(SettingsError, match="each of big_0, small_0, big_1, small_1 is needed once"):
        flatten_groups(TwoKinds(), {"big": ["big_0"], "small": ["small_0", "small_1"]})
    with pytest.raises(SettingsError, match="observation_space of big_0 and of small_0 differ"):
        flatten_groups(TwoKinds(), {"all": list(LIVES)})
    with pytest.raises(SettingsError, match="a PettingZoo parallel env is needed"):
        flatten_groups("env")
    envs = flatten_groups(TwoKinds(), seed=0)
    models = models_of(envs)
    with pytest.raises(SettingsError, match="models: the group small has none"):
        learn_groups({"big": models["big"]}, 5)
    with pytest.raises(SettingsError, match="the env of the model of small is not that of its group"):
        learn_groups({"big": models["big"], "small": models["big"]}, 5)
    with pytest.raises(SettingsError, match="callbacks: bigg is none of the groups big, small"):
        learn_groups(models, 5, {"bigg": Record()})
    others = models_of(flatten_groups(TwoKinds(), seed=0))
    with pytest.raises(SettingsError, match="not of one flatten_groups"):
        learn_groups({"big": models["big"], "small": others["small"]}, 5)
