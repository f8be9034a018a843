"""The shipped configs: each loads, holds only what differs from the defaults, and its header says how to run it."""

import re
import shlex
from pathlib import Path

import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation.model_cards import read_card
from sb3_flock.pretrained import shipped_policies
from sb3_flock.rl.registry import ALGORITHMS, uses_compact_buffer
from sb3_flock.serialization.migrate import migrate_config
from sb3_flock.serialization.yaml_io import load_config, read_yaml
from sb3_flock.settings import field_of, group_of, resolve_path
from sb3_flock.sweep.config import SweepConfig, load_sweep

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "configs").glob("*.yaml"))
SWEEPS = [path for path in FILES if path.name.startswith("sweep_")]
TRAININGS = [path for path in FILES if path not in SWEEPS]
HEADER = ("# For: ", "# Takes: ", "# Gives: ", "# Command: ")
TRAINED_BY = {"ddpg": "experiment2_5v2o", "flock": "flock", "paper-plain": "paper_plain"}
"""The config of each shipped policy."""


def load(name):
    return load_config(TrainingConfig, ROOT / "configs" / f"{name}.yaml")


def leaves(values, prefix=""):
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def defaults_in(values, config):
    """The keys whose value is the one that the config has without them, and the groups without any key."""
    written = dict(leaves(values))
    for key in written:
        if key not in dict(leaves(config.model_dump(mode="json"))) and group_of(field_of(type(config), key).annotation):
            yield key
    default = dict(leaves(type(config)().model_dump(mode="json")))
    loaded = dict(leaves(config.model_dump(mode="json")))
    yield from (key for key in written if key in loaded and loaded[key] == default[key])


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_header_has_four_lines_and_its_command_names_the_file(path):
    lines = path.read_text().splitlines()
    assert [line[: len(start)] for line, start in zip(lines, HEADER, strict=False)] == list(HEADER)
    assert all(len(line) > len(start) + 5 for line, start in zip(lines, HEADER, strict=False))
    assert not any(line.startswith("#") for line in lines[4:])
    assert re.search(r"\d.* on one core.*, .*(transitions|evaluations)", lines[1])
    words = shlex.split(lines[3].removeprefix(HEADER[3]))
    name = f"configs/{path.name}"
    assert words == ["sb3-flock", *(["sweep", name] if path in SWEEPS else ["train", "--config", name])]


@pytest.mark.parametrize("path", TRAININGS, ids=lambda path: path.stem)
def test_a_config_holds_only_what_differs_from_the_defaults(path):
    assert list(defaults_in(read_yaml(path), load_config(TrainingConfig, path))) == []


def test_a_default_in_a_config_is_found():
    values = {"seed": 0, "scenario": {"n_vehicles": 3, "n_obstacles": 2, "reward": {}}, "train_env": {"flock_sizes": [5]}}
    config = TrainingConfig(**values)
    assert set(defaults_in(values, config)) == {"seed", "scenario.n_vehicles", "scenario.reward", "train_env.flock_sizes"}


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_a_sweep_holds_only_what_differs_from_the_defaults(path):
    values, config = read_yaml(path), load_sweep(path)
    default = {name: field.get_default(call_default_factory=True) for name, field in SweepConfig.model_fields.items()}
    assert [name for name in values if getattr(config, name) == default[name]] == []
    if isinstance(values.get("base"), dict):
        for key, value in values["base"].items():
            named = ".".join(resolve_path(TrainingConfig, key))
            assert dict(leaves(TrainingConfig().model_dump(mode="json")))[named] != value, key


@pytest.mark.parametrize(("name", "setup"), [("1_3v1o", (3, 1)), ("2_5v1o", (5, 1)), ("2_5v2o", (5, 2))])
def test_the_papers_experiments_are_the_defaults_with_its_numbers_of_bodies(name, setup):
    config = load(f"experiment{name}")
    assert (config.scenario.n_vehicles, config.scenario.n_obstacles) == setup
    assert config.replace(scenario=TrainingConfig().scenario) == TrainingConfig()
    assert (config.scenario.safety_filter, config.scenario.shared_detections) == ("announce", True)
    bodies = {"n_vehicles": TrainingConfig().scenario.n_vehicles, "n_obstacles": TrainingConfig().scenario.n_obstacles}
    assert config.scenario.replace(**bodies) == TrainingConfig().scenario


def test_the_plain_method_is_the_papers():
    config = load("paper_plain")
    reward = config.scenario.reward
    assert (reward.link_bonus, reward.separation_penalty, reward.obstacle_penalty, reward.scale) == (1, 1, 1, 1)
    assert (config.algo, config.network.n_critics, config.algorithm.utd_ratio) == ("ddpg", 1, 1)
    assert (config.algorithm.mirror_augmentation, config.algorithm.bc_coef, config.train_env.expert) == (False, 0, None)
    assert (config.scenario.safety_filter, config.scenario.shared_detections) == ("off", False)
    assert config.train_env.action_repeat == 1
    assert config.training_scenarios()[0].replace(obstacle_arena=None) == config.scenario


def effective(config):
    """The config with the values that ``null`` stands for."""
    scenario = config.scenario
    if scenario.obstacle_radius is None:
        scenario = scenario.replace(obstacle_radius=scenario.known_obstacle_range)
    algorithm, network, spec = config.algorithm, config.network, ALGORITHMS[config.algo]
    if algorithm.mirror_augmentation is None:
        algorithm = algorithm.replace(mirror_augmentation=uses_compact_buffer(config))
    if network.action_bound is None and spec.action_bounds:
        network = network.replace(action_bound=spec.action_bounds[0])
    return config.replace(scenario=scenario, algorithm=algorithm, network=network)


@pytest.mark.parametrize("name", sorted(shipped_policies()))
def test_a_shipped_policy_was_trained_by_its_config(name):
    card = read_card(name)
    values, _ = migrate_config(TrainingConfig, card["config"], card["format"])
    trained, config = (
        dict(leaves(effective(each).model_dump(mode="json"))) for each in (TrainingConfig(**values), load(TRAINED_BY[name]))
    )
    differing = {field for field in trained.keys() | config.keys() if trained.get(field) != config.get(field)}
    assert differing <= {"seed", "save_freq"}  # checkpoints change no training
    assert trained["seed"] == card["shipped_seed"]
