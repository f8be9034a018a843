import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import FlockDDPG, make_vec_env, train
from sb3_flock.controllers import EXPERTS, make_controller
from sb3_flock.controllers.mpc import MPCConfig
from sb3_flock.envs.expert_env import ExpertEnv
from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.envs.multi_flock import MultiFlockEnv
from sb3_flock.envs.vec_env import flatten
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World
from tests.helpers import assert_equal_rollouts, quiet, tiny

CROWD = Scenario(n_vehicles=4, n_obstacles=2, arena=0.3, obstacle_arena=0.4, max_cycles=10)


def expert(name, **settings):
    """A function of the world that makes an expert."""
    return lambda world: EXPERTS[name](world, MPCConfig(**settings))


def run_episode(env, actions=None):
    """The positions of one episode and the infos of its steps."""
    positions, infos = [env.unwrapped.world.positions], []
    while env.agents:
        given = dict.fromkeys(env.agents, np.zeros(2, np.float32)) if actions is None else actions.pop(0)
        *_, by_agent = env.step(given)
        positions.append(env.unwrapped.world.positions)
        infos.append(list(by_agent.values()))
    return np.array(positions), infos


def executed(infos):
    return [[info.get("executed_action") for info in step] for step in infos]


def test_the_expert_drives_as_it_does_alone_and_the_infos_hold_the_executed_actions():
    env = ExpertEnv(CROWD, expert("orca"), fraction=1.0, noise_std=0.0)
    env.reset(seed=1)
    positions, infos = run_episode(env)
    assert {info["expert_drives"] for step in infos for info in step} == {True}
    assert not any("expert_action" in info for step in infos for info in step)
    alone = parallel_env(CROWD)
    alone.reset(seed=1)
    actions = [dict(zip(env.possible_agents, step, strict=True)) for step in executed(infos)]
    expected, plain_infos = run_episode(alone, actions)
    np.testing.assert_array_equal(positions, expected)
    assert not any({"expert_drives", "executed_action"} & set(info) for step in plain_infos for info in step)
    controller = make_controller("orca")
    rng = np.random.default_rng(1)
    sensing = alone.world.reset([rng])
    controller.reset([rng], CROWD)
    for step in executed(infos):
        np.testing.assert_array_equal(controller.act(sensing, CROWD)[0], step)
        sensing, _ = alone.world.step([step])


def test_the_expert_drives_its_fraction_of_the_episodes_with_its_noise():
    env = ExpertEnv(CROWD, expert("olfati-saber"), fraction=0.3, noise_std=0.5)
    env.reset(seed=0)
    driven = []
    for _ in range(200):
        drives = env.expert_drives
        _, infos = run_episode(env)
        assert {info["expert_drives"] for step in infos for info in step} == {drives}  # the whole episode or none of it
        assert {"executed_action" in info for step in infos for info in step} == {drives}
        if drives:
            actions = np.array(executed(infos))
            assert (actions >= env.world.action_low).all()
            assert (actions <= env.world.action_high).all()
        driven.append(drives)
        env.reset()
    assert np.mean(driven) == pytest.approx(0.3, abs=0.1)
    assert actions.std(axis=0).min() > 0.01


def test_the_noise_is_of_the_set_standard_deviation_around_the_experts_actions():
    scenario = CROWD.replace(max_cycles=400, max_turn_rate=100.0)  # bounds that the noise seldom reaches
    env = ExpertEnv(scenario, expert("olfati-saber"), fraction=1.0, noise_std=0.1, queries=True)
    env.reset(seed=0)
    _, infos = run_episode(env)
    noise = np.array([[info["executed_action"] - info["expert_action"] for info in step] for step in infos])
    assert noise[..., 1].std() == pytest.approx(0.1 * 100.0, rel=0.05)
    assert abs(noise[..., 1].mean()) < 1.0


@pytest.mark.parametrize("name", ["orca", "mpc"])
def test_a_queried_expert_gives_its_action_in_every_step_of_every_episode(name):
    env = ExpertEnv(CROWD, expert(name), fraction=0.5, noise_std=0.1, queries=True)
    rng = np.random.default_rng(0)
    kinds = set()
    for seed in range(5, 10):
        env.reset(seed=seed)
        world = World(CROWD)
        other = expert(name)(world)
        for _ in range(CROWD.max_cycles):
            world.load_state_dict(env.world.state_dict())
            other.load_state_dict(env.state_dict()["expert"]["memory"])
            queried = env.state_dict()["expert"]["expert_actions"][0]
            actions = rng.uniform(env.world.action_low, env.world.action_high, (4, 2)).astype(np.float32)
            *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
            np.testing.assert_array_equal([info["expert_action"] for info in infos.values()], queried)
            drives = infos["vehicle_0"]["expert_drives"]
            kinds.add(drives)
            assert all(("executed_action" in info) == drives for info in infos.values())
            done = [info.get("executed_action", action) for info, action in zip(infos.values(), actions, strict=True)]
            sensing, _ = world.step([done])
            np.testing.assert_array_equal(other.act(sensing, CROWD), env.state_dict()["expert"]["expert_actions"])
    assert kinds == {True, False}


@pytest.mark.parametrize(
    ("name", "queries"),  # the config accepts no queries of olfati-saber, which integrates its own velocity
    [("orca", True), ("orca", False), ("mpc", True), ("mpc", False), ("olfati-saber", False)],
)
@pytest.mark.parametrize("n_flocks", [1, 3])
def test_a_state_continues_in_the_middle_of_an_episode(name, queries, n_flocks):
    env, other = (ExpertEnv(CROWD, expert(name, n_iterations=20), 0.5, 0.1, queries, n_flocks) for _ in range(2))
    rng = np.random.default_rng(3)
    kinds = set()
    env.reset(seed=0)
    other.reset(seed=9)
    for _ in range(8):
        for step in range(CROWD.max_cycles):
            if step == 4:
                other.load_state_dict(env.state_dict())
                assert other.expert_drives == env.expert_drives
            actions = {
                agent: rng.uniform(env.world.action_low, env.world.action_high).astype(np.float32) for agent in env.agents
            }
            ours = env.step(actions)
            kinds |= {info["expert_drives"] for info in ours[4].values()}
            if step >= 4:
                theirs = other.step(actions)
                for agent in env.possible_agents:
                    np.testing.assert_array_equal(ours[0][agent], theirs[0][agent])
                    assert ours[1][agent] == theirs[1][agent]
                    assert ours[4][agent].keys() == theirs[4][agent].keys()
                    for key in {"expert_drives", "executed_action", "expert_action"} & ours[4][agent].keys():
                        np.testing.assert_array_equal(ours[4][agent][key], theirs[4][agent][key])
        env.reset()  # the random stream continues in both
        other.reset()
        assert other.expert_drives == env.expert_drives
    assert kinds == {True, False}


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_the_infos_of_flattened_flocks_hold_who_drives(num_cpus):
    env = flatten(ExpertEnv(CROWD, expert("orca"), 0.5, 0.1), n_copies=6, num_cpus=num_cpus, seed=0)

    def step():
        *_, infos = env.step(np.zeros((24, 2), np.float32))
        drives = np.array([info["expert_drives"] for info in infos])
        np.testing.assert_array_equal(["executed_action" in info for info in infos], drives)
        by_flock = drives.reshape(6, 4)
        assert (by_flock.all(1) | ~by_flock.any(1)).all()
        return by_flock.any(1)

    try:
        env.reset()
        first = step()
        assert 0 < first.sum() < 6
        for _ in range(25):  # over the ends of two episodes
            last = step()
        assert (last != first).any()  # each episode is drawn anew
    finally:
        env.close()


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_each_copy_queries_its_expert_in_its_own_world(num_cpus):
    pair = MultiFlockEnv([ExpertEnv(CROWD, expert("mpc"), 0.0, 0.0, queries=True) for _ in range(2)])
    env = flatten(pair, n_copies=2, num_cpus=num_cpus, seed=0)
    try:
        env.reset()
        for _ in range(12):  # over the end of an episode
            *_, infos = env.step(np.zeros((16, 2), np.float32))
        queried = np.array([info["expert_action"] for info in infos]).reshape(4, 4, 2)
        assert not any(info["expert_drives"] or "executed_action" in info for info in infos)
        assert len(np.unique(queried.reshape(4, -1), axis=0)) == 4
        if num_cpus == 0:
            flocks = [flock for found in env.get_attr("flocks", indices=range(0, 16, 8)) for flock in found]
            assert all(flock.expert.world is flock.world for flock in flocks)
    finally:
        env.close()


@pytest.mark.parametrize("queries", [True, False])
@pytest.mark.parametrize("name", ["orca", "mpc", "olfati-saber"])
def test_flocks_in_a_batch_equal_flocks_of_an_env_each(name, queries):
    copies = flatten(ExpertEnv(CROWD, expert(name, n_iterations=20), 0.5, 0.1, queries), n_copies=5, seed=1)
    batch = flatten(ExpertEnv(CROWD, expert(name, n_iterations=20), 0.5, 0.1, queries, n_flocks=5), seed=1)
    drivers = assert_equal_rollouts(copies, batch, steps=25)  # over the ends of two episodes
    assert any(0 < sum(info["expert_drives"] for info in infos) < 20 for infos in drivers)


class Record(BaseCallback):
    """Keeps the executed action of each step, the expert's or, by SB3's rollout, the policy's; and the queried actions."""

    def __init__(self):
        super().__init__()
        self.drives, self.actions, self.queried = [], [], []

    def _on_step(self):
        infos, given = self.locals["infos"], self.locals["actions"]
        self.drives.append([info["expert_drives"] for info in infos])
        self.actions.append([info.get("executed_action", action) for info, action in zip(infos, given, strict=True)])
        self.queried.append([info["expert_action"] for info in infos])
        return True


def test_the_replay_buffer_stores_the_executed_and_the_queried_actions(tmp_path):
    record = Record()
    changes = {"expert": "orca", "expert_fraction": 0.5, "bc_coef": 1.0, "n_flocks": 6, "learning_starts": 100}
    model = train(tiny(tmp_path, total_timesteps=540, **changes), quiet(), callbacks=[record]).model
    assert 0.2 < np.mean(record.drives) < 0.8
    buffer = model.replay_buffer
    stored = model.policy.unscale_action(buffer.actions[: buffer.pos])
    np.testing.assert_allclose(stored, record.actions, atol=1e-6)
    queried = model.policy.unscale_action(buffer.expert_actions[: buffer.pos])
    np.testing.assert_allclose(queried, record.queried, atol=1e-6)
    model.save(tmp_path / "with_expert.zip")
    with pytest.raises(SettingsError, match="the infos have no expert_action"):
        FlockDDPG.load(tmp_path / "with_expert.zip", env=make_vec_env(Scenario(), n_flocks=6), device="cpu").learn(400)


def test_the_mpc_expert_has_the_settings_of_the_config(tmp_path):
    config = tiny(tmp_path, expert="mpc", **{"train_env.mpc.n_iterations": 3})
    experts = train(config, quiet()).model.get_env().get_attr("expert")
    assert config.train_env.mpc.n_iterations == 3
    assert {mpc.config for mpc in experts} == {config.train_env.mpc}


def test_mistakes_are_one_line(tmp_path):
    for name, value in (
        ("expert", "random"),
        ("expert_fraction", 1.1),
        ("expert_noise_std", -0.1),
        ("mpc.n_iterations", 0),
    ):
        with pytest.raises(SettingsError, match=f"{name.split('.')[-1]} = "):
            tiny(tmp_path, **{f"train_env.{name}": value})
    for changes, needed in (
        ({}, "input should be 0 without train_env.expert mpc or orca"),
        ({"expert": "olfati-saber"}, "input should be 0 without train_env.expert mpc or orca"),
        ({"expert": "orca", "algo": "td3"}, "input should be 0 without algo ddpg and n_steps 1"),
        ({"expert": "orca", "n_steps": 3}, "input should be 0 without algo ddpg and n_steps 1"),
    ):
        with pytest.raises(SettingsError, match=f"algorithm.bc_coef = 0.5: {needed}"):
            tiny(tmp_path, bc_coef=0.5, **changes)
