import base64
import contextlib
import io
import json
import os
import pickle
import shutil
import stat
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml

from sb3_flock import FlockDDPG, load_policy, save_model
from sb3_flock._renamed import RenamedWarning
from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.migrate import FORMAT
from sb3_flock.serialization.rewrite import rewrite
from sb3_flock.serialization.yaml_io import EarlierFormatWarning, load_config, to_yaml
from sb3_flock.settings import SettingsError, UserError
from sb3_flock.sweep.config import load_sweep
from tests.helpers import SMALL_MODEL

DATA = Path(__file__).parent.parent / "data"
FORMAT_3 = DATA / "format_3"
POLICIES = sorted((DATA / "format_2" / "policies").glob("*.zip"))


def copy(path, tmp_path):
    return Path(shutil.copyfile(path, tmp_path / path.name))


def member(path, name="flock.json"):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read(name))


def tensors(path, name="policy.pth"):
    with zipfile.ZipFile(path) as archive:
        return th.load(io.BytesIO(archive.read(name)), weights_only=True)


def predictions(path):
    policy = load_policy(path)
    observations = np.random.default_rng(0).random((20, *policy.scenario.observation_shape)).astype(np.float32)
    return policy.predict(observations)[0]


# -- policies ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("original", POLICIES, ids=lambda path: path.stem)
def test_a_policy_keeps_its_weights_to_the_last_bit_and_what_its_file_says(original, tmp_path):
    path = copy(original, tmp_path)
    assert rewrite(path)
    before, after = tensors(original), tensors(path)
    assert list(after) == list(before)
    for name, tensor in before.items():
        assert after[name].dtype == tensor.dtype
        assert th.equal(after[name], tensor)
        follows = name.replace("_target.", ".")  # in half precision a target's storage is that of its network
        assert (after[name].data_ptr() == after[follows].data_ptr()) == (tensor.data_ptr() == before[follows].data_ptr())
    assert len({tensor.data_ptr() for tensor in after.values()}) == len({tensor.data_ptr() for tensor in before.values()})
    np.testing.assert_array_equal(predictions(path), predictions(original))
    old, new = member(original), member(path)
    assert (old["format"], new["format"]) == (2, FORMAT)
    assert (new["versions"], new["num_timesteps"]) == (old["versions"], old["num_timesteps"])
    assert TrainingConfig(**new["config"]) == load_policy(original).config
    assert new["config"] == load_policy(original).config.model_dump(mode="json")
    assert path.stat().st_size < 1e6
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("original", POLICIES, ids=lambda path: path.stem)
def test_sb3_loads_a_rewritten_policy_without_a_word_about_old_names(original, tmp_path):
    path = copy(original, tmp_path)
    with pytest.warns(RenamedWarning):
        FlockDDPG.load(path, device="cpu")
    rewrite(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = FlockDDPG.load(path, device="cpu")
    old = member(original, "data")
    for name in ("num_timesteps", "n_envs", "buffer_size", "gradient_steps", "_n_updates", "_total_timesteps", "seed"):
        assert getattr(model, name) == old[name]
    policy = load_policy(path)
    observations = np.random.default_rng(0).random((5, *policy.scenario.observation_shape)).astype(np.float32)
    np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], policy.predict(observations)[0])


def test_half_precision_and_shared_storage_stay(tmp_path):
    original = next(path for path in POLICIES if path.stem == "crossing-5v2o")
    path = copy(original, tmp_path)
    rewrite(path)
    after = tensors(path)
    assert {tensor.dtype for tensor in after.values()} == {th.float16}
    targets = [name for name in after if "_target." in name]
    assert targets
    assert all(after[name].data_ptr() == after[name.replace("_target.", ".")].data_ptr() for name in targets)


def test_a_policy_of_format_1_is_rewritten_with_its_actions(tmp_path):
    original = DATA / "format_1" / "policy.zip"
    path = copy(original, tmp_path)
    assert rewrite(path)
    assert (member(original)["format"], member(path)["format"]) == (1, FORMAT)
    np.testing.assert_array_equal(predictions(path), predictions(original))
    for name, tensor in load_policy(original).policy.state_dict().items():
        assert th.equal(load_policy(path).policy.state_dict()[name], tensor)
    assert FlockDDPG.load(path, device="cpu").num_timesteps == load_policy(original).num_timesteps


def test_the_optimizers_states_stay(tmp_path):
    final = DATA / "format_2" / "expected" / "ddpg.zip"
    path = copy(final, tmp_path)
    assert rewrite(path)
    old, new = (tensors(file, "actor.optimizer.pth") for file in (final, path))
    assert old["state"]
    for key, state in old["state"].items():
        assert all(th.equal(state[name], new["state"][key][name]) for name in state)


def test_rewriting_is_idempotent_and_leaves_a_present_file_alone(model, tmp_path):
    path = copy(POLICIES[0], tmp_path)
    assert rewrite(path)
    content = path.read_bytes()
    assert not rewrite(path)
    assert path.read_bytes() == content
    present = save_model(model, tmp_path / "present.zip", SMALL_MODEL)
    content = present.read_bytes()
    assert not rewrite(present)
    assert present.read_bytes() == content


def test_what_cannot_be_rewritten_is_refused_in_one_line_and_stays(tmp_path):
    checkpoint = next((DATA / "format_2" / "runs" / "ddpg").glob("rl_model_*_steps.zip"))
    files = {
        copy(checkpoint, tmp_path): "a checkpoint, which is migrated when its training is resumed",
        copy(DATA / "format_2" / "plain" / "plain_ddpg.zip", tmp_path): "saved by SB3 alone, without a config",
        tmp_path / "none.zip": "No such file",
        tmp_path: "Is a directory",
    }
    damaged = copy(POLICIES[0], tmp_path)
    damaged.write_bytes(damaged.read_bytes()[:-3000])
    text = tmp_path / "text.txt"
    text.write_text("x")
    files |= {damaged: "not a policy", text: "not a policy"}
    for file, message in files.items():
        before = file.read_bytes() if file.is_file() else None
        with pytest.raises(UserError, match=message) as error:
            rewrite(file)
        assert str(error.value).startswith(f"{file}: ")
        assert before is None or file.read_bytes() == before


def test_no_code_of_a_file_is_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = copy(POLICIES[0], tmp_path)
    data = member(path, "data")
    touch = pickle.dumps(_Touch(), protocol=0)
    data["policy_class"][":serialized:"] = base64.b64encode(touch).decode()
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**parts, "data": json.dumps(data).encode()}.items():
            archive.writestr(name, content)
    with pytest.raises(Exception), _quietly():  # noqa: B017, PT011 - SB3 does run it
        FlockDDPG.load(path, device="cpu")
    Path("owned").unlink()
    assert rewrite(path)
    assert not Path("owned").exists()
    with _quietly():
        FlockDDPG.load(path, device="cpu")
    assert not Path("owned").exists()


@contextlib.contextmanager
def _quietly():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class _Touch:
    """Its pickle creates a file when it is read."""

    def __reduce__(self):
        return os.system, ("touch owned",)


def test_a_failed_write_leaves_the_file_and_nothing_else(tmp_path, monkeypatch):
    path = copy(POLICIES[0], tmp_path)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SettingsError, match="No space left"):
        rewrite(path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_the_files_mode_stays(tmp_path):
    path = copy(POLICIES[0], tmp_path)
    path.chmod(0o640)
    rewrite(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


# -- model cards -------------------------------------------------------------------------------------------------------


def test_a_card_gets_the_present_format_and_keeps_the_rest(tmp_path):
    policy = load_policy(next(path for path in POLICIES if path.stem == "second-look-5v2o"))
    card = {"name": "second-look-5v2o", "seeds": [{"seed": 0, "metrics": {"return": -3.8}}], "other": 0.1}
    path = tmp_path / "card.json"
    path.write_text(json.dumps({**card, "config": member(policy.path)["config"]}))
    assert rewrite(path)
    new = json.loads(path.read_text())
    assert new == {**card, "format": FORMAT, "config": policy.config.model_dump(mode="json")}
    content = path.read_bytes()
    assert not rewrite(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"config": 3, "seeds": []}', '{"config": {"practice": {"vehicles": -1}}, "seeds": []}']
)
def test_another_json_file_is_refused_in_one_line(text, tmp_path):
    path = tmp_path / "card.json"
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        rewrite(path)
    assert str(error.value).startswith(f"{path}: ")
    assert path.read_text() == text


# -- configs -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("run", ["ddpg", "ddpg_expert"])
def test_a_whole_config_is_written_with_every_comment(run, tmp_path):
    path = copy(DATA / "format_2" / "runs" / run / "config.yaml", tmp_path)
    path.write_text("# mine\n\n# for 5 vehicles\n" + path.read_text())
    with pytest.warns(EarlierFormatWarning):
        config = load_config(TrainingConfig, path)
    assert rewrite(path)
    assert path.read_text() == "# mine\n\n# for 5 vehicles\n" + to_yaml(config)
    assert load_config(TrainingConfig, path) == config
    assert not rewrite(path)


def test_a_part_of_a_config_keeps_its_keys_and_leading_comments_and_says_what_was_the_default(tmp_path):
    path = tmp_path / "config.yaml"
    text = (
        "# mine\nlearner: # a comment\n  guidance: 10.0\n  gamma: 0.9\npractice:\n  teacher: foresight\n  vehicles: [3, 5]\n"
    )
    path.write_text(text + "seed: 1\n")
    with pytest.warns(EarlierFormatWarning):
        config = load_config(TrainingConfig, path)
    assert rewrite(path)
    assert path.read_text().startswith("# mine\nalgorithm:")
    values = yaml.safe_load(path.read_text())
    assert list(values) == ["algorithm", "train_env", "seed", "scenario"]
    assert values["algorithm"] == {"bc_coef": 10.0, "gamma": 0.9}
    assert values["train_env"].items() >= {"expert": "mpc", "flock_sizes": [3, 5], "action_repeat": 1}.items()
    assert values["scenario"].items() >= {"safety_filter": "off", "shared_detections": False}.items()
    assert load_config(TrainingConfig, path) == config
    assert not rewrite(path)


def test_a_config_with_present_names_stays_as_it_is(tmp_path):
    path = tmp_path / "config.yml"
    text = "seed: 1 # a comment\nalgorithm: {gamma: 0.9}\n"
    path.write_text(text)
    assert not rewrite(path)
    assert path.read_text() == text


def test_a_number_of_the_format_is_raised(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("format: 2\nseed: 1\n")
    assert rewrite(path)
    values = yaml.safe_load(path.read_text())
    assert (values["format"], values["seed"], values["scenario"]["safety_filter"]) == (FORMAT, 1, "off")
    assert not rewrite(path)


def test_files_of_format_3_are_rewritten_with_the_task_that_they_had(tmp_path):
    policy, config = copy(FORMAT_3 / "announce.zip", tmp_path), copy(FORMAT_3 / "run" / "config.yaml", tmp_path)
    before = load_config(TrainingConfig, config)
    assert rewrite(policy)
    assert rewrite(config)
    assert member(policy)["format"] == FORMAT
    assert load_policy(policy).config == load_policy(FORMAT_3 / "announce.zip").config
    np.testing.assert_array_equal(predictions(policy), predictions(FORMAT_3 / "announce.zip"))
    assert config.read_text() == to_yaml(before)
    assert load_config(TrainingConfig, config) == before
    assert before.scenario.safety_filter == "off"


def test_a_card_without_a_format_is_of_format_3(tmp_path):
    path = tmp_path / "card.json"
    config = member(FORMAT_3 / "unfiltered.zip")["config"]
    for leaves_out in ("safety_filter", "shared_detections"):
        config["scenario"].pop(leaves_out)
    path.write_text(json.dumps({"name": "mine", "seeds": [], "config": config}))
    assert rewrite(path)
    card = json.loads(path.read_text())
    assert (card["name"], card["format"], card["config"]["scenario"]["safety_filter"]) == ("mine", FORMAT, "off")
    assert not rewrite(path)
    path.write_text(json.dumps({**card, "format": FORMAT + 1}))
    with pytest.raises(SettingsError, match=f"format = {FORMAT + 1}: this version reads formats 1 to {FORMAT}"):
        rewrite(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("format: 9\n", "format = 9"),
        ("learner:\n  gama: 1\n", "algorithm.gama is not a parameter; did you mean algorithm.gamma?"),
        ("practice: 3\n", "train_env = 3: a mapping"),
        ("practice:\n  vehicles: -1\n", "train_env.flock_sizes"),
        ("[1]\n", "a mapping of parameters is needed"),
    ],
)
def test_a_wrong_config_is_refused_in_one_line(text, message, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        rewrite(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)
    assert path.read_text() == text


def test_a_sweeps_config_gets_the_present_names(tmp_path):
    path = tmp_path / "sweep.yaml"
    path.write_text(
        "# mine\nbase:\n  practice.vehicles: 5\n  learner:\n    guidance: 0.0\n  n_obstacles: 2\n"
        "grid:\n  noise: [0.1, 0.2]\n  practice.separation_ratio: [1.0, 1.1]\n  seed: [0, 1]\n"
        "tasks: [practice.separation_ratio]\n"
    )
    with pytest.warns(RenamedWarning):
        before = load_sweep(path)
    assert rewrite(path)
    assert path.read_text().startswith("# mine\n")
    values = yaml.safe_load(path.read_text())
    assert values["base"] == {"train_env.flock_sizes": 5, "algorithm": {"bc_coef": 0.0}, "n_obstacles": 2}
    assert list(values["grid"]) == ["action_noise_std", "train_env.separation_scale", "seed"]
    assert values["tasks"] == ["train_env.separation_scale"]
    assert load_sweep(path) == before
    assert not rewrite(path)


def test_a_sweep_of_a_shipped_policy_gets_its_present_name(tmp_path):
    path = tmp_path / "sweep.yaml"
    path.write_text("policy: paper-5v2o\ngrid:\n  n_vehicles: [1, 2]\n")
    assert rewrite(path)
    assert yaml.safe_load(path.read_text()) == {"policy": "ddpg", "grid": {"n_vehicles": [1, 2]}}


# -- the warning of a file that was not rewritten -----------------------------------------------------------------------


def test_few_old_names_are_all_in_the_warning_and_many_are_counted(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("learner:\n  guidance: 0.0\n")
    with pytest.warns(EarlierFormatWarning) as caught:
        load_config(TrainingConfig, path)
    assert str(caught[0].message) == (
        f"{path}: written by an earlier release (learner is now algorithm, algorithm.guidance is now algorithm.bc_coef)"
    )
    whole = DATA / "format_2" / "runs" / "ddpg" / "config.yaml"
    with pytest.warns(EarlierFormatWarning) as caught:
        load_config(TrainingConfig, whole)
    message = str(caught[0].message)
    assert message.startswith(f"{whole}: written by an earlier release (practice is now train_env, ")
    assert message.endswith(" more)")
    assert message.count("is now") == 2
    assert "sb3-flock" not in message
    assert caught[0].message.path == whole
