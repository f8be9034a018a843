import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import FlockDDPG, make_vec_env, train
from sb3_flock.controllers import EXPERTS, make_controller
from sb3_flock.envs.expert_env import ExpertEnv
from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.envs.multi_flock import MultiFlockEnv
from sb3_flock.envs.vec_env import flatten
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World
from tests.helpers import quiet, tiny

CROWD = Scenario(n_vehicles=4, n_obstacles=2, arena=0.3, obstacle_arena=0.4, max_cycles=10)


def fly(env, actions=None):
    """Positions and flown actions of one episode."""
    positions, flown = [env.unwrapped.world.positions], []
    while env.agents:
        *_, infos = env.step(dict.fromkeys(env.agents, np.zeros(2, np.float32)) if actions is None else actions.pop(0))
        positions.append(env.unwrapped.world.positions)
        flown.append([info.get("action") for info in infos.values()])
    return np.array(positions), flown


def test_the_teacher_flies_as_it_does_alone_and_the_infos_tell_how():
    env = ExpertEnv(CROWD, EXPERTS["orca"], share=1.0, noise=0.0)
    env.reset(seed=1)
    positions, flown = fly(env)
    alone = parallel_env(CROWD)
    alone.reset(seed=1)
    expected, nothing = fly(alone, [dict(zip(env.possible_agents, actions, strict=True)) for actions in flown])
    np.testing.assert_array_equal(positions, expected)
    assert {action for step in nothing for action in step} == {None}
    controller = make_controller("orca")
    rng = np.random.default_rng(1)
    sensing = alone.world.reset([rng])
    controller.reset([rng], CROWD)
    for actions in flown:
        np.testing.assert_array_equal(controller.act(sensing, CROWD)[0], actions)
        sensing, _ = alone.world.step([actions])


def test_it_flies_its_share_of_the_episodes_with_its_noise():
    env = ExpertEnv(CROWD, EXPERTS["olfati-saber"], share=0.3, noise=0.5)
    env.reset(seed=0)
    taught = []
    for _ in range(200):
        _, flown = fly(env)
        kinds = {action is None for step in flown for action in step}
        assert len(kinds) == 1  # the whole episode or none of it
        if kinds == {False}:
            actions = np.array(flown)
            assert (actions >= env.world.action_low).all()
            assert (actions <= env.world.action_high).all()
        taught.append(kinds == {False})
        env.reset()
    assert np.mean(taught) == pytest.approx(0.3, abs=0.1)
    assert actions.std(axis=0).min() > 0.01


@pytest.mark.parametrize("adviser", ["orca", "mpc"])
def test_an_adviser_says_in_every_step_what_it_would_do_there(adviser):
    env = ExpertEnv(CROWD, EXPERTS[adviser], share=0.5, noise=0.1, advises=True)
    rng = np.random.default_rng(0)
    kinds = set()
    for seed in range(5, 10):
        env.reset(seed=seed)
        world = World(CROWD)
        expert = EXPERTS[adviser](world)
        for _ in range(CROWD.max_cycles):
            world.load_state_dict(env.world.state_dict())
            teacher.load_state_dict(env.state_dict()["taught"]["memory"])
            advice = env.state_dict()["taught"]["advice"]
            actions = rng.uniform(env.world.action_low, env.world.action_high, (4, 2)).astype(np.float32)
            *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
            np.testing.assert_array_equal([info["advice"] for info in infos.values()], advice)
            kinds.add("action" in infos["vehicle_0"])
            flown = [info.get("action", action) for info, action in zip(infos.values(), actions, strict=True)]
            sensing, _ = world.step([flown])
            np.testing.assert_array_equal(teacher.act(sensing, CROWD)[0], env.state_dict()["taught"]["advice"])
    assert kinds == {True, False}


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_flattened_flocks_tell_what_was_flown(num_cpus):
    env = flatten(ExpertEnv(CROWD, EXPERTS["orca"], 0.5, 0.1), n_copies=6, num_cpus=num_cpus, seed=0)
    try:
        env.reset()
        *_, infos = env.step(np.zeros((24, 2), np.float32))
        taught = np.array(["action" in info for info in infos]).reshape(6, 4)
        assert (taught.all(1) | ~taught.any(1)).all()
        assert 0 < taught.any(1).sum() < 6
        for _ in range(25):  # over the ends of two episodes
            *_, infos = env.step(np.zeros((24, 2), np.float32))
            again = np.array(["action" in info for info in infos]).reshape(6, 4)
            assert (again.all(1) | ~again.any(1)).all()
        assert (again.any(1) != taught.any(1)).any()  # each episode is drawn anew
    finally:
        env.close()


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_each_copy_is_advised_of_its_own_world(num_cpus):
    pair = MultiFlockEnv([ExpertEnv(CROWD, EXPERTS["mpc"], 0.0, 0.0, advises=True) for _ in range(2)])
    env = flatten(pair, n_copies=2, num_cpus=num_cpus, seed=0)
    try:
        env.reset()
        for _ in range(12):  # over the end of an episode
            *_, infos = env.step(np.zeros((16, 2), np.float32))
        advice = np.array([info["advice"] for info in infos]).reshape(4, 4, 2)
        assert not any("action" in info for info in infos)
        assert len(np.unique(advice.reshape(4, -1), axis=0)) == 4
        if num_cpus == 0:
            flocks = [flock for copy in env._copies(range(0, 16, 8)) for flock in copy.unwrapped.flocks]
            assert all(flock.expert.world is flock.world for flock in flocks)
    finally:
        env.close()


class Record(BaseCallback):
    """Keeps what each step flew: the teacher's action or, by SB3's rollout, the policy's."""

    def __init__(self):
        super().__init__()
        self.taught, self.actions, self.advice = [], [], []

    def _on_step(self):
        infos, given = self.locals["infos"], self.locals["actions"]
        self.taught.append(["action" in info for info in infos])
        self.actions.append([info.get("action", action) for info, action in zip(infos, given, strict=True)])
        self.advice.append([info.get("advice", (0, 0)) for info in infos])
        return True


def test_the_replay_buffer_takes_what_was_flown(tmp_path):
    record = Record()
    changes = {"expert": "orca", "expert_fraction": 0.5, "bc_coef": 1.0, "n_flocks": 6, "learning_starts": 100}
    model = train(tiny(tmp_path, total_timesteps=540, **changes), quiet(), callbacks=[record]).model
    taught = np.array(record.taught)
    assert 0.2 < taught.mean() < 0.8
    buffer = model.replay_buffer
    stored = model.policy.unscale_action(buffer.actions[: buffer.pos])
    np.testing.assert_allclose(stored, record.actions, atol=1e-6)
    advised = model.policy.unscale_action(buffer.advice[: buffer.pos])
    np.testing.assert_allclose(advised, record.advice, atol=1e-6)
    model.save(tmp_path / "guided.zip")
    with pytest.raises(SettingsError, match="advice = True: only a ExpertEnv that advises gives it"):
        FlockDDPG.load(tmp_path / "guided.zip", env=make_vec_env(Scenario(), n_flocks=6), device="cpu").learn(400)


def test_foresight_keeps_what_the_config_says(tmp_path):
    config = tiny(tmp_path, expert="mpc", **{"train_env.mpc.rounds": 3})
    teachers = train(config, quiet()).model.get_env().get_attr("expert")
    assert config.train_env.mpc.rounds == 3
    assert {teacher.gains for teacher in teachers} == {config.train_env.mpc}


def test_mistakes_are_one_line(tmp_path):
    for name, value in (("expert", "random"), ("expert_fraction", 1.1), ("expert_noise_std", -0.1), ("foresight.rounds", 0)):
        with pytest.raises(SettingsError, match=f"{name.split('.')[-1]} = "):
            tiny(tmp_path, **{f"train_env.{name}": value})
    needed = "bc_coef = 0.5: input should be 0 without train_env.expert orca or foresight, algo ddpg and n_steps 1"
    for changes in ({}, {"expert": "olfati-saber"}, {"expert": "orca", "algo": "td3"}, {"expert": "orca", "n_steps": 3}):
        with pytest.raises(SettingsError, match=needed):
            tiny(tmp_path, bc_coef=0.5, **changes)
