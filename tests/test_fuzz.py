"""Bad input: one clear line or a right answer, never a traceback, a hang or a wrong acceptance.

A short version runs with the other tests; ``pytest -m slow tests/test_fuzz.py`` tries 10 000 of each.
"""

import io
import json
import math
import zipfile

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_flock import Scenario, TrainingConfig, load_policy, make_vec_env, save_model
from sb3_flock.cli import main
from sb3_flock.cli.train import CONFIG_FLAGS
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.load import PolicyError
from sb3_flock.serialization.yaml_io import load_config, to_yaml
from sb3_flock.settings import SettingsError, leaf_paths
from tests.helpers import SMALL_MODEL

FEW, MANY = 100, 10_000


def examples(count):
    """Hypothesis's settings: no deadline for one example, the same examples every time."""
    checks = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much]
    return settings(max_examples=count, deadline=None, derandomize=True, database=None, suppress_health_check=checks)


def both(test):
    """The test with few examples, and with many under the mark ``slow``."""
    return pytest.mark.parametrize(
        "count", [FEW, pytest.param(MANY, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])], ids=["short", "long"]
    )(test)


def expect_one_line(error):
    assert str(error).isprintable()
    assert len(str(error)) <= 2000


# -- scenarios and configs ---------------------------------------------------------------------------------------------

plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
values = st.one_of(
    st.integers(-3, 200),
    st.floats(0, 10),
    st.sampled_from(
        ["cpu", "sac", "walk", "crossing", "tanh", "null", "1e3", "-0.0", 1e300, 5e-324, 10**30, math.nan, math.inf]
    ),
    plain,
    st.lists(plain, max_size=3),
    st.dictionaries(st.text(max_size=4), plain, max_size=2),
)
scenario_fields = st.dictionaries(st.sampled_from([*Scenario.model_fields, "speed", ""]), values, max_size=6)
paths = [".".join(path) for path in leaf_paths(TrainingConfig)]
overrides = st.dictionaries(st.sampled_from([*paths, "gama", "reward", "scenario.reward"]), values, max_size=6)


@both
def test_a_scenario_is_right_or_refused(count):
    @examples(count)
    @given(scenario_fields)
    def check(fields):
        try:
            scenario = Scenario(**fields)
        except SettingsError as error:
            expect_one_line(error)
            return
        for name, value in fields.items():
            taken = getattr(scenario, name)
            if isinstance(value, int | float) and isinstance(taken, int | float):
                assert taken == value  # what was asked for is what is simulated
        numbers = [getattr(scenario, name) for name in Scenario.model_fields]
        assert all(math.isfinite(number) for number in numbers if isinstance(number, float))
        assert scenario.neighbor_separation <= scenario.link_range
        assert scenario.obstacle_separation <= scenario.detection_range
        assert Scenario(**scenario.model_dump()) == scenario

    check()


@both
def test_a_config_is_right_or_refused_and_survives_its_yaml(count, tmp_path):
    file = tmp_path / "config.yaml"

    @examples(count)
    @given(overrides)
    def check(changes):
        try:
            config = load_config(TrainingConfig, overrides=changes)
        except SettingsError as error:
            expect_one_line(error)
            return
        file.write_text(to_yaml(config), encoding="utf-8")
        assert load_config(TrainingConfig, file) == config

    check()


# -- command lines -----------------------------------------------------------------------------------------------------

flags = [
    *(flag for names, _ in CONFIG_FLAGS.values() for flag in names),
    "--scenario",
    "--out",
    "--output",
    "-o",
    "-n",
    "--n_vehicles",
    "--set",
    "--config",
    "--resume",
    "--help",
    "--version",
    "--trust",
    "--json",
    "--controller",
    "--episodes",
]
words = st.one_of(
    st.sampled_from(flags),
    st.sampled_from(
        [
            "0",
            "3",
            "-1",
            "1e9",
            "1e400",
            "nan",
            "orca",
            "walk",
            "no/such",
            "reward.lambda_=0.5",
            "gamma=",
            "=1",
            "a=[[",
            "x=*a",
        ]
    ),
    st.text(max_size=6),
)
commands = st.sampled_from(
    [
        "config",
        "evaluate",
        "evaluate no/such",
        "train --resume no/such/run",
        "reproduce -o /dev/null/x",
        "render no/such -o episode.gif",
        "play no/such",
        "export no/such -o policy.onnx",
        "ros2 no/such --vehicle 0",
        "compare no/such",
        "enjoy no/such",
        "policies no-such",
        "migrate no/such",
    ]
)


@both
def test_a_command_line_never_ends_in_a_traceback(count, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "sb3_flock.cli.shared.evaluate_and_print", lambda *args, **kwargs: {}
    )  # evaluation has its own tests

    @examples(count)
    @given(commands, st.lists(words, max_size=5))
    def check(command, more):
        try:
            code = main([*command.split(), *more])
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        assert code in {0, 2}
        if code == 2:
            lines = captured.err.strip().split("\n")
            assert lines[-1].startswith("sb3-flock")
            most = 1 + len(more) if command.startswith("migrate") else 1  # it refuses each file in a line of its own
            assert 1 <= len(lines) - captured.err.count("warning:") <= most
            assert all(line.startswith("sb3-flock") for line in lines)

    check()


# -- files -------------------------------------------------------------------------------------------------------------

TEXT = to_yaml(TrainingConfig())
bits = [
    "{",
    "}",
    "[",
    "]",
    "&a ",
    "*a",
    "!!python/object/apply:os.system ['true']",
    "\t",
    "\0",
    "\x85",
    "9" * 5000,
    "- ",
    "? ",
    "<<: *a",
    "é",
]


@both
def test_a_mutated_yaml_is_read_right_or_refused(count, tmp_path):
    file = tmp_path / "config.yaml"
    edit = st.tuples(st.integers(0, len(TEXT)), st.integers(0, 40), st.sampled_from(bits) | st.text(max_size=6))

    @examples(count)
    @given(st.lists(edit, min_size=1, max_size=4))
    def check(edits):
        text = TEXT
        for start, length, new in edits:
            text = text[:start] + new + text[start + length :]
        file.write_text(text, encoding="utf-8", newline="")
        try:
            config = load_config(TrainingConfig, file)
        except SettingsError as error:
            expect_one_line(error)
            return
        assert TrainingConfig(**config.model_dump()) == config

    check()


@pytest.mark.parametrize("key", ["seed", "scenario", "network.channels", "output_dir"])
def test_a_million_laughs_are_refused_at_once(key):
    laughs = ["a0: &a0 [ha, ha, ha, ha, ha, ha, ha, ha, ha]"]
    laughs += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 20)]
    value = yaml.safe_load("\n".join(laughs))["a19"]
    group, _, name = key.rpartition(".")
    with pytest.raises(SettingsError) as error:
        TrainingConfig(**({group: {name: value}} if group else {key: value}))
    expect_one_line(error.value)


@pytest.fixture(scope="module")
def policy_zip(tmp_path_factory):
    config = SMALL_MODEL.replace(
        network=SMALL_MODEL.network.replace(channels=(1, 1), features_dim=1, net_arch=(1,), action_layer=1)
    )
    model = build_model(config, make_vec_env(config.scenario, 1, seed=0))
    return save_model(model, tmp_path_factory.mktemp("policy") / "policy.zip", config).read_bytes()


@both
def test_a_mutated_zip_acts_or_is_refused(count, policy_zip, tmp_path):
    file = tmp_path / "mutated.zip"
    size = len(policy_zip)
    edit = st.tuples(st.integers(0, size), st.integers(0, 60), st.binary(max_size=8) | st.just(b"PK\x01\x02"))

    @examples(count)
    @given(st.lists(edit, min_size=1, max_size=4), st.booleans())
    def check(edits, at_the_end):
        content = policy_zip
        for start, length, new in edits:
            at = size - 1 - start % 2500 if at_the_end else start  # the directory and the member that is read
            content = content[:at] + new + content[at + length :]
        file.write_bytes(content)
        act_or_refuse(file)

    check()


@both
def test_a_mutated_description_acts_or_is_refused(count, policy_zip, tmp_path):
    file = tmp_path / "mutated.zip"
    with zipfile.ZipFile(io.BytesIO(policy_zip)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    member = json.loads(parts["flock.json"])
    places = [(("format",), 2), (("num_timesteps",), 0), (("versions",), {}), (("config",), {})]
    places += [(("config", *path), None) for path in leaf_paths(TrainingConfig)]

    @examples(count)
    @given(st.lists(st.tuples(st.sampled_from([path for path, _ in places]), values), min_size=1, max_size=3))
    def check(edits):
        changed = json.loads(json.dumps(member))
        for path, value in edits:
            level = changed
            for name in path[:-1]:
                level = level.get(name) if isinstance(level, dict) else None
            if isinstance(level, dict):
                level[path[-1]] = value
        with zipfile.ZipFile(file, "w") as archive:
            for name, content in {**parts, "flock.json": json.dumps(changed)}.items():
                archive.writestr(name, content)
        act_or_refuse(file)

    check()


def act_or_refuse(file):
    """The actions of a file that loads are within their bounds."""
    import numpy as np

    try:
        policy = load_policy(file)
    except PolicyError as error:
        expect_one_line(error)
        return
    observations = np.zeros((2, *policy.scenario.observation_shape), dtype=np.float32)
    actions, _ = policy.predict(observations)
    assert np.isfinite(actions).all()
    assert (np.abs(actions) <= (policy.scenario.max_speed * (1 + 1e-6), policy.scenario.max_turn_rate * (1 + 1e-6))).all()
