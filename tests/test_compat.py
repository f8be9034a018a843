"""A contract for each private attribute of SB3, SuperSuit and Ray that the package uses: what breaks if it changes."""

import ast
import importlib
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import DDPG, SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.td3.policies import TD3Policy

import sb3_flock
from sb3_flock import Scenario, _compat, flatten, flocking_v0, make_vec_env


def pendulum(algorithm=DDPG, n_envs=1, **kwargs):
    env = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1", max_episode_steps=15)] * n_envs)
    small = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 500, "learning_starts": 20, "batch_size": 8, "device": "cpu"}
    return algorithm("MlpPolicy", env, seed=0, **{**small, **kwargs})


def class_of(path):
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


# -- SB3 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("algorithm", "count"), [(DDPG, 2), (SAC, 3)])
def test_optimizers_or_zips_would_keep_their_states(algorithm, count):
    model = pendulum(algorithm)
    found = _compat.optimizers_of(model)
    assert len(found) == count
    assert model.actor.optimizer in found
    assert model.critic.optimizer in found
    if algorithm is SAC:
        assert model.ent_coef_optimizer in found


def test_number_of_updates_or_the_panel_would_show_no_speed():
    model = pendulum()
    assert _compat.n_updates(model) == 0
    model.learn(50)
    assert _compat.n_updates(model) == 30


def test_remaining_progress_or_the_noise_would_not_decay():
    seen, rates = [], []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append(_compat.progress_remaining(self.model))
            return True

    model = pendulum(learning_rate=lambda remaining: rates.append(remaining) or 1e-3)
    model.learn(50, callback=Watch())
    np.testing.assert_allclose(seen, 1 - np.arange(50) / 50, atol=0.021)
    assert seen == sorted(seen, reverse=True)
    assert set(rates[-5:]) <= {*seen, _compat.progress_remaining(model)}


def test_noise_std_or_exploration_would_stay_as_it_began():
    noise = NormalActionNoise(np.zeros(2), np.full(2, 9.0))
    _compat.set_noise_std(noise, 0.25)
    np.random.seed(0)  # noqa: NPY002 - what SB3 draws from
    np.testing.assert_allclose(np.std([noise() for _ in range(4000)], axis=0), 0.25, rtol=0.05)


def test_counters_or_a_resumed_training_would_count_from_zero():
    model, other = pendulum(), pendulum()
    model.learn(50)
    values = _compat.counters(model)
    assert values["_n_updates"] == 30
    assert values["_episode_num"] == 3
    assert values["_current_progress_remaining"] == pytest.approx(0, abs=0.03)
    _compat.set_counters(other, values)
    assert _compat.counters(other) == values
    assert _compat.n_updates(other) == 30


def test_last_observations_or_a_checkpoint_would_continue_from_others():
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append(self.locals["new_obs"].copy())
            return True

    model = pendulum(n_envs=2)
    model.learn(8, callback=Watch())
    np.testing.assert_array_equal(_compat.last_observations(model), seen[-1])


def test_begin_at_or_the_current_episodes_would_be_reset():
    model, other = pendulum(n_envs=2), pendulum(n_envs=2)
    model.learn(8)
    observations, episodes = _compat.last_observations(model), [{"r": -3.0, "l": 15, "t": 0.1}]
    resets = []
    other.env.reset = lambda: resets.append(1) or observations
    _compat.begin_at(other, observations, episodes)
    assert list(other.ep_info_buffer) == episodes
    assert isinstance(other.ep_info_buffer, deque)
    assert other.ep_info_buffer.maxlen == 100

    class StopAtOnce(BaseCallback):
        def _on_step(self):
            return False

    other.env.step_async = lambda actions: None
    other.env.step_wait = lambda: (observations, np.zeros(2), np.zeros(2, bool), [{}, {}])
    other.learn(8, callback=StopAtOnce(), reset_num_timesteps=False)
    assert not resets
    assert list(other.ep_info_buffer) == episodes


def test_episode_state_or_zips_would_grow_with_the_number_of_envs(tmp_path):
    model = pendulum(n_envs=4)
    model.learn(8)
    assert all(getattr(model, name) is not None for name in _compat.EPISODE_STATE if name != "_last_original_obs")
    assert hasattr(model, "_last_original_obs")
    model.save(tmp_path / "model.zip", exclude=_compat.EPISODE_STATE)
    loaded = DDPG.load(tmp_path / "model.zip", env=model.get_env(), device="cpu")
    assert all(getattr(loaded, name) is None for name in _compat.EPISODE_STATE)
    loaded.learn(8, reset_num_timesteps=False)  # it resets its env first
    assert loaded.num_timesteps == 16


# -- SuperSuit -------------------------------------------------------------------------------------------------------


def test_copies_in_process_or_get_attr_and_state_dict_would_miss_flocks():
    env = flatten(flocking_v0.parallel_env(Scenario(n_vehicles=2)), n_copies=3, seed=0)
    env.reset()
    copies = _compat.copies_in_process(env.venv)
    assert [copy.unwrapped.scenario.n_vehicles for copy in copies] == [2, 2, 2]
    assert len({id(copy.unwrapped) for copy in copies}) == 3
    positions = [copy.unwrapped.world.positions.copy() for copy in copies]
    env.step(np.tile(env.action_space.high, (6, 1)))
    assert all((copy.unwrapped.world.positions != before).any() for copy, before in zip(copies, positions, strict=True))


def test_workers_are_recognized_and_reset_with_given_seeds_or_flocks_would_repeat_each_other():
    scenario = Scenario(n_vehicles=2, max_cycles=5)
    alone, workers = make_vec_env(scenario, n_flocks=4, seed=0), make_vec_env(scenario, n_flocks=4, num_cpus=2, seed=0)
    try:
        assert not _compat.is_multiprocess(alone.venv)
        assert _compat.is_multiprocess(workers.venv)
        expected, _ = alone.venv.reset(seed=40)
        for _ in range(2):
            observations, infos = _compat.reset_workers(workers.venv, [40, 42], None, workers.num_envs)
            np.testing.assert_array_equal(observations, expected)
            assert len(infos) == 8
        other, _ = _compat.reset_workers(workers.venv, [40, 40], None, workers.num_envs)
        np.testing.assert_array_equal(other[4:], other[:4])
    finally:
        alone.close()
        workers.close()


# -- Ray -------------------------------------------------------------------------------------------------------------


def test_ray_addresses_or_a_sweep_would_start_a_cluster_of_its_own(monkeypatch):
    services = pytest.importorskip("ray._private.services")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert _compat.find_ray_cluster("192.0.2.7:6379") == "192.0.2.7:6379"
    assert _compat.find_ray_cluster("local") == ""
    with pytest.raises(ValueError, match="Invalid address format"):
        _compat.find_ray_cluster("no address")
    monkeypatch.setattr(services, "find_gcs_addresses", set)  # as on a machine where no cluster runs
    monkeypatch.setattr(services, "find_bootstrap_address", lambda *_: None)
    with pytest.raises(ConnectionError):
        _compat.find_ray_cluster("auto")
    monkeypatch.setattr(services, "find_gcs_addresses", lambda: {"192.0.2.8:1234"})
    assert _compat.find_ray_cluster("auto") == "192.0.2.8:1234"


def test_ray_trials_or_a_sweep_would_have_no_results():
    tune = pytest.importorskip("ray.tune")
    results = tune.ResultGrid(SimpleNamespace(trials=[]))
    assert _compat.ray_trials(results) == []
    results._experiment_analysis.trials.append("trial")
    assert _compat.ray_trials(results) == ["trial"]


# -- what subclasses inherit -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("path", "name"), [(path, name) for path, names in _compat.INHERITED.items() for name in names])
def test_inherited_members_exist(path, name):
    owner = class_of(path)
    assert hasattr(owner, name) or hasattr(pendulum(owner), name)


def test_the_learning_rate_is_updated_or_schedules_would_have_no_effect():
    model = pendulum(learning_rate=lambda remaining: 1e-3 * remaining)
    model.learn(2)
    model._current_progress_remaining = 0.25
    model._update_learning_rate([model.actor.optimizer])
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(2.5e-4)


def test_samples_come_from_get_samples_or_the_compact_buffer_would_give_sb3s():
    calls = []

    class Watched(ReplayBuffer):
        def _get_samples(self, batch_inds, env=None):
            calls.append(len(batch_inds))
            return super()._get_samples(batch_inds, env)

    model = pendulum(replay_buffer_class=Watched)
    model.learn(25)
    assert set(calls) == {8}


def test_constructor_parameters_and_extractors_or_policies_would_not_load():
    class Policy(TD3Policy):
        def _get_constructor_parameters(self):
            return {**super()._get_constructor_parameters(), "net_arch": [4]}

    env = pendulum().get_env()
    policy = Policy(env.observation_space, env.action_space, lambda _: 1e-3, net_arch=[8])
    extractor = policy.make_features_extractor()
    kwargs = policy._update_features_extractor(policy.critic_kwargs, extractor)
    assert kwargs["features_extractor"] is extractor
    assert policy._get_constructor_parameters()["net_arch"] == [4]


def test_indices_of_a_vec_env_or_get_attr_would_ask_the_wrong_copies():
    env = make_vec_env(Scenario(n_vehicles=2), n_flocks=3, seed=0)
    assert list(env._get_indices(None)) == list(range(6))
    assert list(env._get_indices(4)) == [4]
    assert list(env._get_indices([1, 5])) == [1, 5]


# -- that this is all ------------------------------------------------------------------------------------------------

ROOT = Path(sb3_flock.__file__).parent
SOURCES = {path.relative_to(ROOT).as_posix(): path for path in sorted(ROOT.rglob("*.py"))}
INHERITED_NAMES = {name for names in _compat.INHERITED.values() for name in names}
CALLBACK_HOOKS = {"_init_callback"} | {
    f"_on_{when}" for when in ("step", "training_start", "training_end", "rollout_start", "rollout_end")
}
"""What SB3 documents for its callbacks' subclasses."""


def is_private(name):
    return name.startswith("_") and not name.startswith("__")


def own_names(trees):
    """The private names that classes of these modules define: methods, class members and attributes of ``self``."""
    names = set()
    for tree in trees:
        for cls in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
            for node in ast.walk(cls):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    names.add(node.name)
                elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and is_self(node.value):
                    names.add(node.attr)
                elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    names.add(node.id)
                elif isinstance(node, ast.Call) and ast.unparse(node.func) == "self.register_buffer":
                    names.add(ast.literal_eval(node.args[0]) if isinstance(node.args[0], ast.Constant) else "_taps0")
    return names - INHERITED_NAMES


def is_self(node):
    is_super = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "super"
    return is_super or (isinstance(node, ast.Name) and node.id in {"self", "cls"})


def foreign_accesses(tree, own):
    """Private attributes and modules of others that a module touches, as text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in own:
            if not (is_self(node.value) and node.attr in INHERITED_NAMES):
                yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            module = str(getattr(node, "module", ""))
            names = [part for name in (module, *(alias.name for alias in node.names)) for part in name.split(".")]
            if not module.startswith("sb3_flock") and any(is_private(name) for name in names):
                yield ast.unparse(node)


def test_no_other_module_touches_a_private_attribute_of_a_dependency():
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in SOURCES.items()}
    own = own_names(trees.values())
    found = {name: list(foreign_accesses(tree, own)) for name, tree in trees.items()}
    assert len(found.pop("_compat.py")) > 5  # the search finds what is there
    assert {name: accesses for name, accesses in found.items() if accesses} == {}


@pytest.mark.parametrize(
    "text",
    [
        "model._last_obs = None",
        "print(self.model._n_updates)",
        "self._stats_window_size",
        "import ray._private.services",
        "from ray._private.services import x",
        "from zipfile import _EndRecData",
        "x()._sigma",
    ],
)
def test_the_search_finds_every_kind_of_access(text):
    source = "class Ours:\n    def __init__(self):\n        self._own = 1\n"
    own = own_names([ast.parse(source)])
    assert list(foreign_accesses(ast.parse(text), own))
    assert not list(foreign_accesses(ast.parse("other._own + self._own + self.__dict__"), own))


def test_every_overridden_protected_member_is_listed():
    """A method of ours with the name of a dependency's protected method replaces it."""
    overridden = set()
    for name in SOURCES:
        if name.endswith("__main__.py"):
            continue
        module = importlib.import_module(
            ".".join(["sb3_flock", *name.removesuffix(".py").split("/")]).removesuffix(".__init__")
        )
        for cls in vars(module).values():
            if not isinstance(cls, type) or cls.__module__ != module.__name__:
                continue
            bases = [base for base in cls.__mro__ if base.__module__.split(".")[0] in {"stable_baselines3", "supersuit"}]
            private = (member for member, value in vars(cls).items() if is_private(member) and callable(value))
            overridden |= {member for member in private if any(member in vars(base) for base in bases)}
    assert {"_setup_model", "_get_samples", "_on_step"} <= overridden  # the search finds what is there
    assert overridden - CALLBACK_HOOKS <= INHERITED_NAMES


def test_every_function_of_the_module_has_a_contract_here():
    names = [name for name, value in vars(_compat).items() if getattr(value, "__module__", "") == _compat.__name__]
    text = Path(__file__).read_text(encoding="utf-8")
    assert len(names) > 10
    assert [name for name in names if f"_compat.{name}(" not in text] == []
