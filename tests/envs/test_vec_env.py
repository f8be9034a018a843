"""The defects between SuperSuit and SB3, each with a test that fails without the adapter's handling."""

import os
import signal
import time

import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecMonitor, VecVideoRecorder

from sb3_flock import FlockCNN, Scenario, flatten, flocking_v0, make_vec_env
from sb3_flock.settings import ActionError, SettingsError
from tests.envs.scripted import Scripted
from tests.helpers import assert_equal_rollouts

SCENARIO = Scenario(n_vehicles=3, n_obstacles=1, max_cycles=5)


def roll(env, steps, seed=0):
    """Observations, rewards, dones and infos of a rollout with seeded actions, the reset first."""
    rng = np.random.default_rng(seed)
    space = env.action_space
    observations = [env.reset()]
    rewards, dones, infos = [], [], []
    for _ in range(steps):
        actions = rng.uniform(space.low, space.high, (env.num_envs, 2)).astype(np.float32)
        observation, reward, done, info = env.step(actions)
        observations.append(observation)
        rewards.append(reward)
        dones.append(done)
        infos.append(info)
    return np.array(observations), np.array(rewards), np.array(dones), infos


@pytest.fixture(params=[0, 1, 2], ids=lambda cpus: f"{cpus}-cpus")
def num_cpus(request):
    return request.param


def tiny_model(env, **kwargs):
    return DDPG(
        "MlpPolicy",
        env,
        policy_kwargs={"features_extractor_class": FlockCNN, "net_arch": [8]},
        learning_starts=30,
        buffer_size=1000,
        batch_size=8,
        action_noise=NormalActionNoise(np.zeros(2), np.full(2, 0.1)),
        device="cpu",
        **kwargs,
    )


# 1. Seeds


def test_copies_differ_and_a_seed_repeats_whatever_the_workers(num_cpus):
    env = make_vec_env(SCENARIO, n_flocks=4, num_cpus=num_cpus, seed=7)
    observations, rewards, _, _ = roll(env, 12)
    env.close()
    by_copy = observations[0].reshape(4, -1)
    assert len({copy.tobytes() for copy in by_copy}) == 4
    reference = make_vec_env(SCENARIO, n_flocks=4, seed=7)
    again, again_rewards, _, _ = roll(reference, 12)
    np.testing.assert_array_equal(observations, again)
    np.testing.assert_array_equal(rewards, again_rewards)


def test_neighboring_seeds_share_no_copy():
    starts = [make_vec_env(SCENARIO, n_flocks=4, seed=seed).reset().reshape(4, -1) for seed in range(3)]
    assert len({copy.tobytes() for start in starts for copy in start}) == 12


def test_a_seed_is_spent_by_one_reset_and_no_seed_means_fresh_entropy():
    env = make_vec_env(SCENARIO, n_flocks=2, seed=7)
    first, second = env.reset(), env.reset()
    assert not np.array_equal(first, second)
    env.seed(7)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(seed=7), first)
    assert not np.array_equal(make_vec_env(SCENARIO, 2).reset(), make_vec_env(SCENARIO, 2).reset())


def test_an_env_that_already_holds_a_random_stream_gives_different_copies():
    env = flocking_v0.parallel_env(SCENARIO)
    env.reset(seed=1)  # every copy is now a clone of this stream
    copies = flatten(env, n_copies=4).reset().reshape(4, -1)
    assert len({copy.tobytes() for copy in copies}) == 4


def test_a_model_takes_a_seed_and_repeats_from_it():
    parameters = []
    for seed in (3, 3, 4):
        model = tiny_model(make_vec_env(SCENARIO, n_flocks=2), seed=seed, gradient_steps=2)
        model.learn(120)
        assert model._n_updates > 0
        parameters.append(np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()]))
    np.testing.assert_array_equal(parameters[0], parameters[1])
    assert not np.array_equal(parameters[0], parameters[2])


@pytest.mark.parametrize(
    "fields", [{}, {"motion_lag": 0.2, "sensors": {"position_noise": 0.01, "dropout": 0.2, "delay": 0.2}}]
)
def test_a_batch_equals_flocks_of_an_env_each(num_cpus, fields):
    scenario = SCENARIO.replace(arena=0.2, obstacle_arena=0.4, **fields)
    batch = make_vec_env(scenario, n_flocks=5, num_cpus=num_cpus, seed=3)  # shared unevenly among two workers
    copies = flatten(flocking_v0.parallel_env(scenario), n_copies=5, num_cpus=num_cpus, seed=3)
    try:
        assert batch.n_agents == copies.n_agents == 3
        infos = assert_equal_rollouts(copies, batch, steps=12)  # over the ends of two episodes
        assert any(len(info["neighbors"]) for info in infos[-1])
    finally:
        batch.close()
        copies.close()


def test_copies_of_a_batch_are_refused_because_their_seeds_would_overlap():
    with pytest.raises(SettingsError, match="n_copies = 2: 1 is needed"):
        flatten(flocking_v0.parallel_env(SCENARIO, n_flocks=3), n_copies=2)


# 2. - 5. The end of an episode


def test_time_limits_are_marked_and_dones_are_boolean(num_cpus):
    env = make_vec_env(SCENARIO, n_flocks=2, num_cpus=num_cpus, seed=0)
    _, _, dones, infos = roll(env, 10)
    env.close()
    assert dones.dtype == bool
    np.testing.assert_array_equal(dones.all(1), [False] * 4 + [True] + [False] * 4 + [True])
    for step, step_infos in enumerate(infos):
        for info in step_infos:
            assert info.get("TimeLimit.truncated", False) == (step % 5 == 4)


class EndsEarly(flocking_v0.parallel_env):
    """Terminates (not truncates) after two steps."""

    def step(self, actions):
        observations, rewards, terminations, truncations, infos = super().step(actions)
        if self.world.steps == 2:
            terminations = dict.fromkeys(terminations, True)
            self.agents = []
        return observations, rewards, terminations, truncations, infos


def test_a_real_end_is_not_a_time_limit():
    _, _, dones, infos = roll(flatten(EndsEarly(SCENARIO), 2, seed=0), 2)
    assert dones[1].all()
    assert all(info["TimeLimit.truncated"] is False for info in infos[1])


def test_timeouts_reach_the_replay_buffer_so_that_learning_bootstraps_through_them():
    model = tiny_model(make_vec_env(SCENARIO, n_flocks=2), seed=0)
    model.learn(6 * 10)
    buffer = model.replay_buffer
    ends = np.arange(10) % 5 == 4
    np.testing.assert_array_equal(buffer.dones[:10].all(1), ends)
    np.testing.assert_array_equal(buffer.timeouts[:10].all(1), ends)


def test_the_last_steps_infos_survive_the_automatic_reset(num_cpus):
    env = make_vec_env(SCENARIO, n_flocks=2, num_cpus=num_cpus, seed=0)
    _, rewards, dones, infos = roll(env, 10)
    env.close()
    for reward, done, step_infos in zip(rewards, dones, infos, strict=True):
        for slot, info in enumerate(step_infos):
            assert reward[slot] == pytest.approx(sum(info["reward_terms"].values()), rel=1e-6)
            assert ("terminal_observation" in info) == done[slot]


def test_terminal_observation_is_that_of_the_last_step_not_of_the_reset(num_cpus):
    env = make_vec_env(SCENARIO, n_flocks=1, num_cpus=num_cpus, seed=5)
    longer = make_vec_env(SCENARIO.replace(max_cycles=50), n_flocks=1, seed=5)
    observations, _, _, infos = roll(env, 5)
    env.close()
    # Obstacles' walks are drawn for whole episodes, longer here: only the waypoint channel can be compared.
    unbroken, _, _, _ = roll(longer, 5)
    terminal = np.array([info["terminal_observation"] for info in infos[4]])
    np.testing.assert_array_equal(terminal[:, 2], unbroken[5][:, 2])
    assert not np.array_equal(terminal, observations[5])


# 6. SB3's helpers


def test_attributes_and_methods_of_the_copies_are_reachable_through_wrappers():
    env = VecMonitor(make_vec_env(SCENARIO, n_flocks=2, seed=0, render_mode="rgb_array"))
    env.reset()
    assert env.get_attr("scenario") == [SCENARIO] * 6
    assert env.get_attr("render_mode", indices=[0, 5]) == ["rgb_array"] * 2
    assert env.render_mode == "rgb_array"
    assert env.n_agents == 3
    env.set_attr("marker", 1)
    assert [copy.marker for copy in env.get_attr("unwrapped", indices=[0, 3])] == [1, 1]
    with pytest.raises(NotImplementedError, match=r"set_attr\('marker'\): the copies share their attributes"):
        env.set_attr("marker", 2, indices=[4])
    assert env.env_method("action_space", "vehicle_0", indices=0) == [env.action_space]
    assert env.env_is_wrapped(VecMonitor) == [False] * 6
    assert env.has_attr("scenario")
    assert not env.has_attr("no_such_thing")
    env.set_options({"any": "thing"})
    env.reset()
    assert len(env.get_images()) == 2
    assert env.render("rgb_array").ndim == 3
    with pytest.raises(AttributeError):
        env.no_such_thing  # noqa: B018


def test_with_workers_the_render_mode_is_known_and_the_rest_refused_clearly():
    env = make_vec_env(SCENARIO, n_flocks=2, num_cpus=2, seed=0, render_mode="rgb_array")
    env.reset()
    assert env.render_mode == "rgb_array"
    assert env.has_attr("render_mode")
    assert env.get_attr("render_mode") == ["rgb_array"] * 6
    assert env.render().shape == (704, 640, 3)
    with pytest.raises(NotImplementedError, match="num_cpus=0"):
        env.get_attr("scenario")
    env.close()


def test_vec_monitor_and_eval_callback_work(tmp_path):
    env, eval_env = (VecMonitor(make_vec_env(SCENARIO, n_flocks=2, seed=seed)) for seed in (0, 1))
    model = tiny_model(env, seed=0)
    callback = EvalCallback(
        eval_env, n_eval_episodes=6, eval_freq=5, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0
    )
    model.learn(6 * 20, callback=callback)
    assert (tmp_path / "best_model.zip").exists()
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (4, 6)
    assert len(model.ep_info_buffer) == 6 * 4
    mean, _ = evaluate_policy(model, eval_env, n_eval_episodes=6)
    assert np.isfinite(mean)


def test_an_episode_can_be_recorded_as_video(tmp_path):
    pytest.importorskip("moviepy")
    env = make_vec_env(SCENARIO, n_flocks=1, seed=0, render_mode="rgb_array")
    recorder = VecVideoRecorder(env, str(tmp_path), record_video_trigger=lambda step: step == 0, video_length=4)
    roll(recorder, 6)
    recorder.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


# 8. Workers


def test_a_killed_worker_is_one_clear_error_and_the_rest_is_closed():
    env = make_vec_env(SCENARIO, n_flocks=2, num_cpus=2, seed=0)
    env.reset()
    procs = env.venv.procs
    os.kill(procs[0].pid, signal.SIGKILL)
    procs[0].join(10)
    with pytest.raises(RuntimeError, match=rf"worker died: process {procs[0].pid} \(exit code -9\)"):
        env.step(np.zeros((6, 2), dtype=np.float32))
    for proc in procs:
        proc.join(10)
        assert not proc.is_alive()


class HasNoDisk(flocking_v0.parallel_env):
    """Fails with an error that a dead worker's pipe would raise, too."""

    def step(self, actions):
        raise OSError("no disk")


def test_an_envs_own_error_is_not_reported_as_a_dead_worker():
    env = flatten(HasNoDisk(SCENARIO), seed=0)
    env.reset()
    with pytest.raises(OSError, match="no disk"):
        env.step(np.zeros((3, 2), dtype=np.float32))


class MarksItsEnd(flocking_v0.parallel_env):
    """Leaves a file named for its process when it is closed."""

    def close(self):
        if getattr(self, "closed_in", None):
            (self.closed_in / str(os.getpid())).touch()
        super().close()


def test_closing_closes_the_workers_envs(tmp_path):
    template = MarksItsEnd(SCENARIO)
    template.closed_in = tmp_path
    env = flatten(template, n_copies=2, num_cpus=2, seed=0)
    env.reset()
    procs = env.venv.procs
    started = time.monotonic()
    env.close()
    env.close()  # a second time has no effect
    assert time.monotonic() - started < 10
    assert {path.name for path in tmp_path.iterdir()} >= {str(proc.pid) for proc in procs}
    assert not any(proc.is_alive() for proc in procs)


def test_closing_twice_closes_the_copies_once():
    class Counts(type(flocking_v0.parallel_env(SCENARIO))):
        closings = 0

        def close(self):
            type(self).closings += 1

    env = flatten(Counts(SCENARIO), n_copies=2, seed=0)
    env.close()
    closings = Counts.closings
    env.close()
    assert closings == Counts.closings > 0


# The rest


def test_slots_are_ordered_copy_by_copy_and_actions_go_to_their_vehicle():
    env = make_vec_env(SCENARIO, n_flocks=2, seed=0)
    env.reset()
    before = [copy.world.positions[0].copy() for copy in env.get_attr("unwrapped", indices=[0, 3])]
    actions = np.zeros((6, 2), dtype=np.float32)
    actions[4] = (0.15, 0.0)  # the second flock's vehicle_1
    env.step(actions)
    after = [copy.world.positions[0] for copy in env.get_attr("unwrapped", indices=[0, 3])]
    has_moved = [np.linalg.norm(a - b, axis=-1) > 0 for a, b in zip(after, before, strict=True)]
    assert has_moved[0].tolist() == [False, False, False]
    assert has_moved[1].tolist() == [False, True, False]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_actions_that_are_not_finite_are_refused_in_one_line(num_cpus, number):
    envs = [make_vec_env(SCENARIO, 2, num_cpus, seed=0), flatten(Scripted(), 2, num_cpus, seed=0)]
    for env in envs:
        env.reset()
        actions = np.zeros((env.num_envs, 2), np.float32)
        actions[4, 1] = number
        with pytest.raises(ActionError, match=rf"^action of slot 4 = \[0.0, {number}\]: finite numbers are needed$"):
            env.step(actions)
        with pytest.raises(ActionError, match=r"^actions have the shape \(2,\): \(\d, 2\) is needed$"):
            env.step(np.zeros(2, np.float32))
        env.step(np.zeros_like(actions))
        env.close()
    alone = flocking_v0.parallel_env(SCENARIO)
    alone.reset(seed=0)
    with pytest.raises(ActionError, match=r"^action of flock 0 vehicle 1 = "):
        alone.step({agent: actions[4 - (agent != "vehicle_1")] for agent in alone.agents})


BAD_COUNTS = [({"n_flocks": 0}, "n_flocks = 0"), ({"num_cpus": -1}, "num_cpus = -1"), ({"seed": -1}, "seed = -1")]


@pytest.mark.parametrize(("kwargs", "name"), BAD_COUNTS)
def test_bad_counts_are_refused_in_one_line(kwargs, name):
    with pytest.raises(SettingsError, match=name):
        make_vec_env(SCENARIO, **kwargs)
