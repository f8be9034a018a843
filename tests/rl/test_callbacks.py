import gymnasium
import numpy as np
import pytest
import supersuit
from mpe2 import simple_spread_v3
from stable_baselines3 import A2C, DDPG, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_flock import CompactReplayBuffer, FlockCNN, NeighborInclusiveReward, Scenario, flatten, make_vec_env
from sb3_flock.rl.alive_buffers import AliveReplayBuffer
from sb3_flock.rl.callbacks import (
    DivergedError,
    DropDeadTransitions,
    FlockMetrics,
    LinearNoiseDecay,
    StopOnNonFiniteLoss,
    StoreExecutedActions,
)
from sb3_flock.settings import SettingsError
from tests.envs.scripted import LIVES, Scripted

CROWDED = Scenario(n_vehicles=4, n_obstacles=1, arena=0.2, obstacle_arena=0.4, neighbor_separation=0.02, max_cycles=5)


class Record(BaseCallback):
    """Keeps every step's rewards, infos, dones and logged values as the callbacks before it left them."""

    def __init__(self):
        super().__init__()
        self.steps, self.logged = [], []

    def _on_step(self):
        self.logged.append(dict(self.logger.name_to_value))
        self.steps.append((self.locals["rewards"].copy(), self.locals["infos"], self.locals["dones"].copy()))
        return True


def learn(env, callbacks, steps, extractor=None, **kwargs):
    policy_kwargs = {"net_arch": [8], **({"features_extractor_class": extractor} if extractor else {})}
    model = DDPG(
        "MlpPolicy",
        env,
        policy_kwargs=policy_kwargs,
        learning_starts=10**9,
        buffer_size=2000,
        device="cpu",
        seed=0,
        **kwargs,
    )
    model.learn(steps * env.num_envs, callback=callbacks)
    return model


def expected_mix(infos, n_agents, lambda_):
    """The mix by the formula, one slot at a time, from the raw rewards that the infos keep."""
    mixed = []
    for slot, info in enumerate(infos):
        first = slot - slot % n_agents
        others = [infos[first + j]["reward"] for j in info["neighbors"]]
        own = info["reward"]
        mixed.append(lambda_ * own + (1 - lambda_) * np.mean(others) if others else own)
    return mixed


def test_the_mixed_reward_reaches_the_replay_buffer_and_the_raw_one_stays():
    env = VecMonitor(make_vec_env(CROWDED, n_flocks=2, seed=1))
    record = Record()
    model = learn(env, [NeighborInclusiveReward(0.7), record], 12, FlockCNN)
    mixes = 0
    for step, (_, infos, _) in enumerate(record.steps):
        raw = [sum(info["reward_terms"].values()) for info in infos]
        np.testing.assert_allclose([info["reward"] for info in infos], raw, rtol=1e-5)
        stored = model.replay_buffer.rewards[step]
        np.testing.assert_allclose(stored, expected_mix(infos, 4, 0.7), rtol=1e-5)
        mixes += int((np.abs(stored - raw) > 1e-6).sum())
    assert mixes > 20
    raw_returns = [sum(infos[0]["reward"] for _, infos, _ in record.steps[:5])]
    assert model.ep_info_buffer[0]["r"] == pytest.approx(raw_returns[0], rel=1e-4)


def test_neighbors_at_the_end_of_an_episode_are_those_of_its_last_step():
    record = Record()
    model = learn(make_vec_env(CROWDED, n_flocks=2, seed=2), [NeighborInclusiveReward(0.5), record], 10, FlockCNN)
    _, infos, dones = record.steps[4]
    assert dones.all()
    # The neighbor channel of the last observation shows whether there are neighbors.
    for info in infos:
        assert (len(info["neighbors"]) > 0) == (info["terminal_observation"][0].max() > 0)
    np.testing.assert_allclose(model.replay_buffer.rewards[4], expected_mix(infos, 4, 0.5), rtol=1e-5)


def test_neighbors_in_a_resets_infos_are_not_those_of_the_last_step():
    env = flatten(Scripted(dict.fromkeys("abcd", (0, 3, "truncation"))), 2, seed=0)  # a reset names d, each step a
    model = learn(env, NeighborInclusiveReward(0.5), 7)
    mixed = np.tile(0.5 * np.array([10, 20, 30, 40]) + 0.5 * 10, 2)
    np.testing.assert_array_equal(model.replay_buffer.rewards[:7], np.tile(mixed, (7, 1)))


def test_mixed_rewards_with_n_step_returns():
    record = Record()
    model = learn(make_vec_env(CROWDED, n_flocks=1, seed=3), [NeighborInclusiveReward(0.5), record], 5, FlockCNN, n_steps=3)
    mixed = np.array([expected_mix(infos, 4, 0.5) for _, infos, _ in record.steps[:3]])
    sample = model.replay_buffer._get_samples(np.zeros(64, dtype=int))  # returns of three steps from the first one on
    returns = mixed[0] + 0.99 * mixed[1] + 0.99**2 * mixed[2]
    for value in sample.rewards.numpy().ravel():
        assert np.isclose(returns, value, rtol=1e-4).any()


def spread_env():
    from pettingzoo.utils import BaseParallelWrapper

    class NeighborContract(BaseParallelWrapper):
        def step(self, actions):
            observations, rewards, terminations, truncations, infos = super().step(actions)
            if not observations:
                return observations, rewards, terminations, truncations, infos
            positions = np.array([observations[agent][2:4] for agent in self.possible_agents])
            distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + np.diag([np.inf] * len(positions))
            for i, agent in enumerate(self.possible_agents):
                infos[agent] = {**infos[agent], "neighbors": np.flatnonzero(distances[i] < 1.0)}
            return observations, rewards, terminations, truncations, infos

    return NeighborContract(simple_spread_v3.parallel_env(N=3, local_ratio=1.0, max_cycles=8, continuous_actions=True))


def test_mixed_rewards_on_an_env_of_another_package():
    record = Record()
    model = learn(flatten(spread_env(), n_copies=2, seed=0), [NeighborInclusiveReward(0.6), record], 20)
    mixed_somewhere = False
    for step, (rewards, infos, _) in enumerate(record.steps):
        np.testing.assert_allclose(model.replay_buffer.rewards[step], expected_mix(infos, 3, 0.6), rtol=1e-5)
        mixed_somewhere |= not np.allclose(rewards, [info["reward"] for info in infos])
    assert mixed_somewhere
    # SuperSuit marks no time limit; flatten() does.
    assert model.replay_buffer.timeouts[7].all()


def test_mixed_rewards_on_supersuits_own_wrapper_with_n_agents_given():
    flat = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(spread_env()), 2, base_class="stable_baselines3"
    )
    record, callback = Record(), NeighborInclusiveReward(0.6, n_agents=3)
    model = DDPG("MlpPolicy", flat, policy_kwargs={"net_arch": [8]}, learning_starts=10**9, buffer_size=500, device="cpu")
    model.learn(20 * 6, callback=[callback, record])
    for step, (_, infos, _) in enumerate(record.steps):
        np.testing.assert_allclose(model.replay_buffer.rewards[step], expected_mix(infos, 3, 0.6), rtol=1e-5)
    returns = [sum(rewards[slot] for rewards, _, _ in record.steps[:8]) for slot in range(6)]
    np.testing.assert_allclose(list(callback._finished)[:6], returns, rtol=1e-5)


def test_an_agent_without_neighbors_in_its_info_keeps_its_reward():
    callback = NeighborInclusiveReward(0.5, n_agents=2)
    np.testing.assert_array_equal(callback.mix(np.array([1.0, 3.0]), [{}, {"neighbors": [0]}]), [1.0, 2.0])


def test_a_neighbor_that_did_not_act_does_not_count():
    callback = NeighborInclusiveReward(0.5, n_agents=3)
    infos = [{"neighbors": [1, 2]}, {"alive": False}, {"neighbors": [1]}]
    np.testing.assert_array_equal(callback.mix(np.array([1.0, 0.0, 5.0]), infos), [3.0, 0.0, 5.0])


def test_the_mixed_return_is_logged_under_its_own_name(tmp_path):
    record = Record()
    env = VecMonitor(make_vec_env(CROWDED, n_flocks=1, seed=1))
    model = DDPG(
        "MlpPolicy", env, policy_kwargs={"features_extractor_class": FlockCNN}, buffer_size=500, device="cpu", seed=0
    )
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * 21, callback=[NeighborInclusiveReward(0.3), FlockMetrics(), record], log_interval=4)
    model.logger.close()
    header, *rows = (tmp_path / "progress.csv").read_text().splitlines()
    logged = [dict(zip(header.split(","), row.split(","), strict=False)) for row in rows]
    mixed = np.sum([expected_mix(infos, 4, 0.3) for _, infos, _ in record.steps[:5]], axis=0).mean()
    assert float(logged[0]["rollout/ep_mixed_rew_mean"]) == pytest.approx(mixed, rel=1e-3)
    assert float(logged[0]["rollout/ep_rew_mean"]) != pytest.approx(mixed, rel=1e-3)
    assert any(row["flock/tracking_error"] for row in logged)
    assert any(row["flock/connectivity"] for row in logged)


def test_vec_normalize_is_refused_off_policy():
    env = VecNormalize(make_vec_env(CROWDED, n_flocks=1, seed=1), norm_reward=False)
    with pytest.raises(SettingsError, match="VecNormalize is not accepted with DDPG"):
        learn(env, NeighborInclusiveReward(), 1, FlockCNN)


class MixThenNormalize(Record):
    """The normalized mix by the formula, with the statistics of each step."""

    def _on_step(self):
        super()._on_step()
        raw = [sum(info["reward_terms"].values()) for info in self.locals["infos"]]
        np.testing.assert_allclose([info["reward"] for info in self.locals["infos"]], raw, rtol=1e-5)
        mixed = np.array(expected_mix(self.locals["infos"], 4, 0.7))
        self.steps[-1] += (mixed, self.training_env.normalize_reward(mixed))
        return True


@pytest.mark.parametrize("options", [{}, {"norm_reward": False}, {"clip_reward": 0.5}], ids=str)
def test_on_policy_rewards_are_mixed_and_then_normalized(options):
    env = VecMonitor(VecNormalize(make_vec_env(CROWDED.replace(max_cycles=40), n_flocks=2, seed=1), **options))
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, n_steps=8, batch_size=64, device="cpu", seed=0)
    record, callback = MixThenNormalize(), NeighborInclusiveReward(0.7)
    model.learn(8 * env.num_envs, callback=[callback, record])
    np.testing.assert_allclose(model.rollout_buffer.rewards, [step[-1] for step in record.steps], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(callback._returns, np.sum([step[-2] for step in record.steps], 0), rtol=1e-4)
    changes = [np.abs(mixed - [info["reward"] for info in infos]) > 1e-6 for _, infos, _, mixed, _ in record.steps]
    assert np.sum(changes) > 10


@pytest.mark.parametrize("is_nested", [False, True])
def test_rewards_are_not_mixed_twice(is_nested):
    env, record = make_vec_env(CROWDED, n_flocks=1, seed=1), Record()
    callback = NeighborInclusiveReward()
    twice = (
        [EveryNTimesteps(4, CallbackList([callback])), record, NeighborInclusiveReward()] if is_nested else [callback] * 2
    )
    with pytest.raises(SettingsError, match="NeighborInclusiveReward is among the callbacks more than once"):
        learn(env, twice, 3, FlockCNN)
    assert record.steps == []
    for _ in range(2):  # again with the same callback
        learn(env, [callback, record], 3, FlockCNN)


def test_a_wrong_or_missing_number_of_agents_is_refused():
    env = make_vec_env(CROWDED, n_flocks=1, seed=1)
    for wrong in (3, 2):
        with pytest.raises(SettingsError, match=f"n_agents = {wrong}.*which is 4"):
            learn(env, NeighborInclusiveReward(n_agents=wrong), 1, FlockCNN)
    other = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")])
    with pytest.raises(SettingsError, match="n_agents = None.*divisor of 1"):
        learn(other, NeighborInclusiveReward(), 1)


@pytest.mark.parametrize("lambda_", [-0.1, 1.1, float("nan")])
def test_a_lambda_outside_0_1_is_refused(lambda_):
    with pytest.raises(SettingsError, match="lambda_"):
        NeighborInclusiveReward(lambda_)


def test_noise_decays_linearly():
    env = make_vec_env(CROWDED, n_flocks=1, seed=1)
    model = learn(
        env, LinearNoiseDecay(0.4, 0.2), 10, FlockCNN, action_noise=NormalActionNoise(np.zeros(2), np.full(2, 9.0))
    )
    # Ten vector steps; the last round starts with one tenth of the way left.
    np.testing.assert_allclose(model.action_noise.noises[3]._sigma, 0.22)


class ExpertDrivesVehicle1(BaseCallback):
    """Marks one vehicle's steps as an expert's, as an ExpertEnv does."""

    action = np.array([0.15, 1.0])

    def _on_step(self):
        info = self.locals["infos"][1]
        info["expert_drives"], info["executed_action"] = True, self.action
        info["metrics"] = dict.fromkeys(info["metrics"], 1e9)
        return True


def test_executed_actions_are_stored_where_an_expert_drove():
    env = make_vec_env(CROWDED, n_flocks=1, seed=1)
    model = learn(env, [ExpertDrivesVehicle1(), StoreExecutedActions()], 10, FlockCNN)
    stored = model.replay_buffer.actions[:10]
    np.testing.assert_allclose(stored[:, 1], np.tile([1.0, 1 / np.pi], (10, 1)), rtol=1e-5)
    assert len(np.unique(stored[:, [0, 2, 3], 0])) == 30  # the others' actions are their own


def test_flock_metrics_are_means_without_the_experts_steps():
    env, record = make_vec_env(CROWDED, n_flocks=1, seed=1), Record()
    learn(env, [ExpertDrivesVehicle1(), FlockMetrics(), record], 5, FlockCNN)
    errors = [info["metrics"]["tracking_error"] for _, infos, _ in record.steps for info in (infos[0], *infos[2:])]
    assert record.logged[-1]["flock/tracking_error"] == pytest.approx(np.mean(errors))


class VehicleIsGone(ExpertDrivesVehicle1):
    def _on_step(self):
        super()._on_step()
        self.locals["infos"][1] = {"alive": False}
        return True


def test_flock_metrics_leave_out_slots_without_an_agent():
    env, record = make_vec_env(CROWDED, n_flocks=1, seed=1), Record()
    learn(env, [VehicleIsGone(), FlockMetrics(), record], 5, FlockCNN)
    errors = [info["metrics"]["tracking_error"] for _, infos, _ in record.steps for info in (infos[0], *infos[2:])]
    assert record.logged[-1]["flock/tracking_error"] == pytest.approx(np.mean(errors))


OFF_POLICY = {
    "buffer_size": 400,
    "learning_starts": 30,
    "batch_size": 16,
    "policy_kwargs": {"net_arch": [8]},
    "device": "cpu",
}


@pytest.mark.parametrize("buffer", [None, AliveReplayBuffer, CompactReplayBuffer])
def test_off_policy_only_the_steps_of_living_agents_are_learned_from(buffer):
    seen = []

    class Watched(DDPG):
        def train(self, *args, **kwargs):
            seen.append(self.replay_buffer.sample(64))
            super().train(*args, **kwargs)

    model = Watched("MlpPolicy", flatten(Scripted(), 2, seed=0), replay_buffer_class=buffer, **OFF_POLICY)
    model.learn(30 * model.n_envs, callback=DropDeadTransitions() if buffer is None else None)
    observations = np.concatenate([batch.observations for batch in seen])
    rewards = np.concatenate([batch.rewards for batch in seen])
    assert len(observations) > 500
    np.testing.assert_array_equal(rewards[:, 0], 10 * observations[:, 0])
    assert set(observations[:, 0]) == {1, 2, 3, 4}
    steps = np.concatenate([batch.next_observations for batch in seen])[:, 1]
    np.testing.assert_array_equal(steps, observations[:, 1] + 1)
    ends = np.isin(observations[:, 0], [1, 3]) & np.isin(steps - 1, [3, 5]) & ((observations[:, 0] == 1) == (steps == 4))
    np.testing.assert_array_equal(np.concatenate([batch.dones for batch in seen])[:, 0], ends)  # b and d are truncated


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_on_policy_only_the_steps_of_living_agents_are_learned_from(algorithm):
    batches = []

    class Watched(algorithm):
        def train(self):
            batches.extend(self.rollout_buffer.get(32))
            super().train()

    options = {"batch_size": 32} if algorithm is PPO else {}
    model = Watched("MlpPolicy", flatten(Scripted(), 2, seed=0), n_steps=12, device="cpu", seed=0, **options)
    model.learn(3 * 12 * model.n_envs, callback=DropDeadTransitions())
    steps = 3 * 2 * 2 * sum(end - start for start, end, _ in LIVES.values())  # rollouts of two episodes, of two copies
    observations = np.concatenate([batch.observations for batch in batches])
    assert len(observations) == steps
    assert (observations[:, 0] > 0).all()
    assert {len(batch.observations) for batch in batches} == {32, steps // 3 % 32}


def test_a_model_whose_buffer_cannot_drop_steps_is_refused_in_one_line():
    env = flatten(Scripted(), seed=0)
    model = DDPG("MlpPolicy", env, **OFF_POLICY)
    model.learn(8)
    n_step = DDPG("MlpPolicy", env, n_steps=3, **OFF_POLICY)
    for one, name in ((model, "ReplayBuffer"), (n_step, "NStepReplayBuffer")):
        with pytest.raises(SettingsError, match=f"^DropDeadTransitions: the model has a {name}; SB3's own"):
            one.learn(8, callback=DropDeadTransitions())
    again = DDPG("MlpPolicy", env, **OFF_POLICY)
    for _ in range(2):
        again.learn(8, callback=DropDeadTransitions(), reset_num_timesteps=False)
    assert again.replay_buffer.size() == 13  # of four vector steps; a died after three, c joined after two


@pytest.mark.parametrize("name", ["train/actor_loss", "train/bc_loss"])
def test_a_loss_that_is_not_finite_stops_the_training(name):
    class Diverge(BaseCallback):
        def _on_step(self):
            self.logger.record(name, float("nan") if self.num_timesteps >= 12 else 1.0)
            return True

    env = make_vec_env(CROWDED, n_flocks=1, seed=1)
    with pytest.raises(DivergedError, match=f"{name} = nan after 12 transitions: the training diverged"):
        learn(env, [StopOnNonFiniteLoss(), Diverge()], 10, FlockCNN)
