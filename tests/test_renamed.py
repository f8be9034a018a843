"""Names of the previous release: each one works, with a warning that names the present one."""

import importlib
import subprocess
import sys
import warnings

import numpy as np
import pytest

from sb3_flock import FlockDDPG, Scenario, TrainingConfig, _renamed, load_policy, make_vec_env
from sb3_flock._renamed import FIELDS, POLICIES, VALUES, RenamedWarning
from sb3_flock.config.training import TrainEnvConfig
from sb3_flock.controllers.mpc import MPC, MPCConfig
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.rl.buffers import CompactReplayBuffer
from sb3_flock.rl.settings import AlgorithmConfig
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import SettingsError, resolve_path

SETTINGS = {
    settings.__name__: settings for settings in (Scenario, TrainingConfig, TrainEnvConfig, MPCConfig, AlgorithmConfig)
}

CHANGED = {
    "motion_lag": 0.2, "train_env": {"flock_sizes": (7,)}, "algorithm": {"gamma": 0.9}, "n_eval_episodes": 7,
    "n_test_episodes": 9, "flock_sizes": (2, 3), "obstacle_arena_scale": 0.7, "time_step_scale": 1.5,
    "separation_scale": 1.5, "obstacle_separation_scale": 1.2, "expert": "orca", "expert_fraction": 0.5,
    "expert_noise_std": 0.3, "mpc": {"horizon": 5}, "max_link_length": 0.5, "link_cutoff": 0.4, "link_weight": 1.0,
    "obstacle_visibility": 2.0, "horizon": 6, "n_iterations": 8, "step_size": 0.5, "bc_coef": 1.0,
    "mirror_augmentation": False, "utd_ratio": 0.9, "action_noise_std": 0.2, "final_action_noise_std": 0.1,
}  # fmt: skip
"""A value of each renamed field other than its default."""


@pytest.mark.parametrize(("owner", "old", "new"), [(owner, *names) for owner in SETTINGS for names in FIELDS[owner].items()])
def test_a_field_under_its_old_name(owner, old, new):
    settings, value = SETTINGS[owner], CHANGED[new]
    with pytest.warns(RenamedWarning, match=f"^{owner}: {old} is now {new}; the old name works for one release$") as caught:
        config = settings(**{old: value})
    assert [warning.filename for warning in caught] == [__file__]  # the caller's line, not the package's
    assert config == settings(**{new: value})
    assert config != settings()


@pytest.mark.parametrize(("owner", "old", "new"), [(owner, *names) for owner in SETTINGS for names in FIELDS[owner].items()])
def test_a_field_under_both_names_is_refused(owner, old, new):
    value = CHANGED[new]
    with pytest.raises(SettingsError, match=f"^{old} is not a parameter of {owner}"):
        SETTINGS[owner](**{old: value, new: value})


def test_every_renamed_class_is_tested_here():
    assert set(FIELDS) == {*SETTINGS, "FlockDDPG", "CompactReplayBuffer"}
    assert {new for owner in SETTINGS for new in FIELDS[owner].values()} == set(CHANGED)


def test_groups_under_old_names_with_old_names_within():
    with pytest.warns(RenamedWarning) as caught:
        config = TrainingConfig(
            scenario={"look_back": 0.2},
            practice={"vehicles": 5, "teacher": "foresight", "foresight": {"rounds": 3}},
            learner={"guidance": 0.5, "noise": 0.3},
        )
    assert config == TrainingConfig(
        scenario={"motion_lag": 0.2},
        train_env={"flock_sizes": 5, "expert": "mpc", "mpc": {"n_iterations": 3}},
        algorithm={"bc_coef": 0.5, "action_noise_std": 0.3},
    )
    reported = "\n".join(str(warning.message) for warning in caught)
    for old in ("practice", "learner", "look_back", "vehicles", "teacher", "foresight", "rounds", "guidance", "noise"):
        assert f": {old} is now " in reported
    assert "expert = foresight is now expert = mpc" in reported


@pytest.mark.parametrize(
    ("owner", "field", "old", "new"), [(*where, *values) for where in VALUES for values in VALUES[where].items()]
)
def test_an_old_value(owner, field, old, new):
    with pytest.warns(RenamedWarning, match=f"{owner}: {field} = {old} is now {field} = {new}"):
        config = SETTINGS[owner](**{field: old})
    assert getattr(config, field) == new


@pytest.mark.parametrize(
    ("old", "path"),
    [
        ("practice.vehicles", ("train_env", "flock_sizes")),
        ("look_back", ("scenario", "motion_lag")),
        ("learner.update_ratio", ("algorithm", "utd_ratio")),
        ("practice.foresight.reach", ("train_env", "mpc", "max_link_length")),
        ("eval_episodes", ("n_eval_episodes",)),
    ],
)
def test_an_old_key_of_an_override(old, path):
    with pytest.warns(RenamedWarning, match=f"{old} is now {'.'.join(path)}"):
        assert resolve_path(TrainingConfig, old) == path


def test_an_override_under_its_old_key_changes_the_config():
    with pytest.warns(RenamedWarning, match=r"practice\.vehicles is now train_env\.flock_sizes"):
        assert load_config(TrainingConfig, overrides={"practice.vehicles": 6}).train_env.flock_sizes == (6,)


def test_a_file_with_old_names_warns_once(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("format: 2\nscenario: {look_back: 0.2}\npractice: {vehicles: 5}\nlearner: {mirror: false}\n")
    with pytest.warns(RenamedWarning, match="practice is now train_env, learner is now algorithm") as caught:
        config = load_config(TrainingConfig, path)
    assert len(caught) == 1
    assert (config.scenario.motion_lag, config.train_env.flock_sizes) == (0.2, (5,))
    assert config.algorithm.mirror_augmentation is False


SPACES = observation_space(Scenario()), action_space(Scenario())


@pytest.mark.parametrize(
    ("old", "new", "attribute"),
    [
        ("mirror", "mirror_augmentation", lambda buffer: buffer.mirror_augmentation),
        ("advice", "store_expert_actions", lambda buffer: buffer.expert_actions is not None),
    ],
)
def test_an_option_of_the_replay_buffer(old, new, attribute):
    assert FIELDS["CompactReplayBuffer"][old] == new
    assert not attribute(CompactReplayBuffer(10, *SPACES))
    with pytest.warns(RenamedWarning, match=f"CompactReplayBuffer: {old} is now {new}") as caught:
        assert attribute(CompactReplayBuffer(10, *SPACES, **{old: True}))
    assert [warning.filename for warning in caught] == [__file__]
    with pytest.raises(TypeError, match=f"CompactReplayBuffer got {new} and its old name {old}"):
        CompactReplayBuffer(10, *SPACES, **{old: True, new: True})
    with pytest.raises(TypeError, match="unexpected argument 'mirrors'"):
        CompactReplayBuffer(10, *SPACES, mirrors=True)


def test_an_option_of_the_algorithm():
    assert FIELDS["FlockDDPG"] == {"guidance": "bc_coef"}
    kwargs = {
        "policy_kwargs": {"net_arch": [8]},
        "buffer_size": 10,
        "device": "cpu",
        "replay_buffer_class": CompactReplayBuffer,
        "replay_buffer_kwargs": {"store_expert_actions": True},
    }
    env = make_vec_env(Scenario(), n_flocks=1)
    policy = importlib.import_module("sb3_flock.rl.policies").FlockPolicy
    with pytest.warns(RenamedWarning, match="FlockDDPG: guidance is now bc_coef") as caught:
        model = FlockDDPG(policy, env, guidance=0.5, **kwargs)
    assert [warning.filename for warning in caught] == [__file__]
    assert model.bc_coef == 0.5
    with pytest.raises(TypeError, match="FlockDDPG got bc_coef and its old name guidance"):
        FlockDDPG(policy, env, guidance=0.5, bc_coef=0.5, **kwargs)


@pytest.mark.parametrize(("old", "new"), POLICIES.items())
def test_a_policy_under_its_old_name(old, new):
    with pytest.warns(RenamedWarning, match=f"policy {old} is now {new}, with its own task and the safety filter"):
        policy = load_policy(old)
    assert policy.path == load_policy(new).path
    assert policy.path.name == f"{new}.zip"


def test_a_file_of_an_old_policys_name_is_that_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paper-3v1o").write_bytes(load_policy("flock").path.read_bytes())
    assert load_policy("paper-3v1o").scenario == load_policy("flock").scenario


@pytest.fixture
def _fresh_imports():
    """Each old module warns when it is first imported: here, as if none had been."""
    imported = {name: module for name, module in sys.modules.items() if name.removeprefix("sb3_flock.") in _renamed._MODULES}
    for name in imported:
        del sys.modules[name]
    yield
    sys.modules.update(imported)


@pytest.mark.usefixtures("_fresh_imports")
@pytest.mark.parametrize(("old", "new"), _renamed._MODULES.items())
def test_an_old_module_is_imported_with_a_warning(old, new):
    with pytest.warns(RenamedWarning) as caught:
        module = importlib.import_module(f"sb3_flock.{old}")
    reported = [str(warning.message) for warning in caught]  # the package of an old module may be an old one, too
    assert reported[-1] == f"sb3_flock.{old} is now sb3_flock.{new}; the old name works for one release"
    present = importlib.import_module(f"sb3_flock.{new}")
    shared = [
        name for name, value in vars(present).items() if getattr(value, "__module__", None) == present.__name__
        and not name.startswith("_") and name not in _renamed._MEMBERS
    ]  # fmt: skip
    for name in shared:
        assert getattr(module, name) is getattr(present, name)
    with pytest.raises(AttributeError, match="no_such_member"):
        module.no_such_member  # noqa: B018


@pytest.mark.usefixtures("_fresh_imports")
@pytest.mark.parametrize(("name", "target"), _renamed._MEMBERS.items())
def test_an_old_member_is_the_present_one(name, target):
    module, _, member = target.partition(":")
    expected = getattr(importlib.import_module(f"sb3_flock.{module}"), member)
    with pytest.warns(RenamedWarning):
        old = importlib.import_module("sb3_flock.rl.training")  # a renamed member is known in every old module
    assert getattr(old, name) is expected


OLD_IMPORTS = {
    "envs.demonstrations": ["DemonstratedEnv"],
    "envs.side_by_side": ["SideBySide"],
    "evaluation.compare": ["load_runs", "results_table", "differences_table"],
    "evaluation.controllers": ["CONTROLLERS", "TEACHERS", "make_controller"],
    "evaluation.controllers.foresight": ["Foresight", "ForesightGains"],
    "evaluation.controllers.motion": ["Velocities", "steer", "limit", "rotate"],
    "evaluation.controllers.olfati_saber": ["OlfatiSaber", "OlfatiGains"],
    "evaluation.controllers.orca": ["Orca", "OrcaGains"],
    "evaluation.controllers.simple": ["GoToWaypoint", "RandomController"],
    "evaluation.episodes": ["Controller", "PolicyController", "as_controller", "evaluate", "fly", "fly_one", "fly_together"],
    "evaluation.figures": ["record", "trajectories", "lines", "save"],
    "evaluation.film": ["render"],
    "play": ["Game", "play"],
    "rl.algorithms": ["ALGORITHMS", "build_model"],
    "rl.checkpoints": ["LoadedCheckpoint", "Checkpoints"],
    "rl.config": ["LearnerConfig", "NetworkConfig", "PracticeConfig", "TrainingConfig"],
    "rl.config_io": ["load_config", "to_yaml"],
    "rl.extractor": ["FlockCNN"],
    "rl.loading": ["LoadedPolicy", "PolicyError", "load_policy", "shipped_policies"],
    "rl.onboard": ["Onboard", "export"],
    "rl.policy": ["FlockPolicy", "FlockSACPolicy"],
    "rl.progress": ["FlockProgress"],
    "rl.replay": ["AdvisedSamples", "CompactReplayBuffer"],
    "rl.safety": ["Checkpoints", "DivergedError", "FiniteLosses", "Signals"],
    "rl.saving": ["save_model"],
    "rl.selection": ["Evaluation"],
    "rl.training": ["TrainingResult", "resume", "train"],
}
"""What programs for the previous release may import, by module."""


@pytest.mark.usefixtures("_fresh_imports")
@pytest.mark.parametrize(("module", "names"), OLD_IMPORTS.items())
def test_old_imports_work(module, names):
    with pytest.warns(RenamedWarning):
        old = importlib.import_module(f"sb3_flock.{module}")
    for name in names:
        assert getattr(old, name) is not None


@pytest.mark.usefixtures("_fresh_imports")
def test_an_old_class_is_the_present_class():
    with pytest.warns(RenamedWarning):
        from sb3_flock.evaluation.controllers.foresight import Foresight, ForesightGains
    with pytest.warns(RenamedWarning):
        from sb3_flock.rl.config import LearnerConfig, PracticeConfig
    assert (Foresight, ForesightGains) == (MPC, MPCConfig)
    assert (LearnerConfig, PracticeConfig) == (AlgorithmConfig, TrainEnvConfig)
    with pytest.warns(RenamedWarning, match="AlgorithmConfig: update_ratio is now utd_ratio"):
        assert LearnerConfig(update_ratio=0.7).utd_ratio == 0.7


def test_an_unknown_module_stays_unknown():
    for name in ("sb3_flock.rl.nothing", "sb3_flock.evaluation.controllers.nothing", "rl.config"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RenamedWarning)
            with pytest.raises(ModuleNotFoundError):
                importlib.import_module(name)


def test_present_names_do_not_warn():
    code = (
        "import warnings; warnings.simplefilter('error'); import sb3_flock._renamed; "
        "warnings.simplefilter('ignore'); warnings.simplefilter('error', sb3_flock._renamed.RenamedWarning); "
        "import sb3_flock; [getattr(sb3_flock, name) for name in sb3_flock.__all__]; "
        "sb3_flock.TrainingConfig(); sb3_flock.load_policy('ddpg')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_the_finder_is_installed_once():
    before = list(sys.meta_path)
    _renamed.install()
    assert sys.meta_path == before
    assert sum(isinstance(finder, _renamed._RenamedModules) for finder in before) == 1


@pytest.mark.parametrize(
    ("module", "name"),
    [(module, name) for module, names in _renamed._MEMBERS_OF_KEPT_MODULES.items() for name in names],
)
def test_an_old_member_of_a_module_whose_name_stays_warns_and_works(module, name):
    home = importlib.import_module(f"sb3_flock.{module}")
    with pytest.warns(RenamedWarning, match=rf"sb3_flock\.{module}\.{name} is now"):
        assert callable(getattr(home, name))
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        home.nothing  # noqa: B018


def test_the_old_sense_of_a_world_still_works():
    from sb3_flock.sim import World, episode_rng

    with pytest.warns(RenamedWarning):
        from sb3_flock.sim import sense
    world = World(Scenario())
    sensing = world.reset([episode_rng(0, 0)])
    np.testing.assert_array_equal(sense(world).waypoint_positions, sensing.waypoint_positions)


def test_a_controller_without_the_base_class_warns_and_works():
    from sb3_flock.evaluation import evaluate

    class Standing:
        def reset(self, rngs, scenario):
            self.shape = (len(rngs), scenario.n_vehicles, 2)

        def act(self, sensing, scenario):
            return np.zeros(self.shape)

    with pytest.warns(RenamedWarning, match="Standing"):
        metrics = evaluate(Standing(), Scenario(max_cycles=5), episodes=3)
    assert metrics["tracking_error"].n == 3
