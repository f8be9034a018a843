"""Policies from untrusted files: loaded or refused in one line, no code of theirs is run; and files of plain SB3."""

import base64
import io
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flock import FlockCNN, FlockDDPG, FlockPolicy, Scenario, evaluate, load_policy, make_vec_env
from sb3_flock.serialization.load import PolicyError
from sb3_flock.settings import ActionError, SettingsError
from tests.helpers import SMALL_MODEL, expert_vec_env


def rewrite(path, changes):
    """The same archive with some members changed or (None) left out."""
    copy = path.with_name("changed.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(copy, "w") as new:
        for name in old.namelist():
            content = changes.get(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return copy


def test_a_run_folder_means_its_best_model_else_its_final_one(saved, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(PolicyError, match=r"no best_model"):
        load_policy(run)
    shutil.copy(saved, run / "final_model.zip")
    assert load_policy(run).path.name == "final_model.zip"
    shutil.copy(saved, run / "best_model.zip")
    assert load_policy(run).path.name == "best_model.zip"


def broken_files(saved):
    """Files that are no policy, with words of the error."""
    whole = saved.read_bytes()
    with zipfile.ZipFile(saved) as archive:
        member = json.loads(archive.read("flock.json"))
    truncated, text, empty = (saved.with_name(name) for name in ("truncated.zip", "text.zip", "empty.zip"))
    truncated.write_bytes(whole[: len(whole) // 2])
    text.write_text("not a zip")
    empty.write_bytes(b"")
    wider = {**member, "config": {**member["config"], "network": {**member["config"]["network"], "features_dim": 32}}}
    unknown = {**member, "config": {**member["config"], "color": "red"}}
    yield saved.with_name("missing.zip"), "no such file"
    yield truncated, "damaged or not a policy"
    yield text, "damaged or not a policy"
    yield empty, "damaged or not a policy"
    for changes, words in (
        ({"flock.json": None, "data": None}, "not a policy of sb3_flock"),
        ({"flock.json": b"{"}, "damaged or not a policy"),
        ({"flock.json": b"[]"}, "do not fit"),
        ({"flock.json": json.dumps(wider).encode()}, "do not fit"),
        ({"flock.json": json.dumps(unknown).encode()}, "color is not a parameter"),
        ({"flock.json": json.dumps({**member, "format": 9}).encode()}, "format = 9"),
        ({"policy.pth": b"garbage"}, "damaged or not a policy"),
        ({"policy.pth": None}, "damaged or not a policy"),
    ):
        yield rewrite(saved, changes), words


def test_files_that_are_no_policy_are_refused_in_one_line(saved):
    for path, words in broken_files(saved):
        with pytest.raises(PolicyError, match=words) as error:
            load_policy(path)
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)


def test_weights_that_are_not_finite_are_refused(model, saved):
    state = {name: value.clone() for name, value in model.policy.state_dict().items()}
    state["actor.mu.0.bias"][0] = float("nan")
    with saved.with_name("policy.pth").open("wb") as file:
        th.save(state, file)
    with pytest.raises(PolicyError, match="not finite"):
        load_policy(rewrite(saved, {"policy.pth": saved.with_name("policy.pth").read_bytes()}))


@pytest.mark.parametrize("number", ["Infinity", "NaN", "-1", "1.5", '"many"', "true"])
def test_a_number_of_transitions_that_is_none_is_refused_in_one_line(number, saved):
    with zipfile.ZipFile(saved) as archive:
        member = json.loads(archive.read("flock.json"))
    member["num_timesteps"] = "HERE"
    changed = json.dumps(member).replace('"HERE"', number).encode()
    with pytest.raises(PolicyError, match=r"num_timesteps = .*: a number of transitions is needed"):
        load_policy(rewrite(saved, {"flock.json": changed}))


class Hostile:
    """Unpickled, it makes a file."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def tensors(state, pickled=None):
    """A ``.pth`` member, with another pickle in it if wanted."""
    file = io.BytesIO()
    th.save(state, file)
    if pickled is None:
        return file.getvalue()
    copy = io.BytesIO()
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(copy, "w") as new:
        for name in old.namelist():
            new.writestr(name, pickled if name.endswith("data.pkl") else old.read(name))
    return copy.getvalue()


def hostile_files(saved, mark):
    """Archives with code in each part that a reader might unpickle."""
    code = pickle.dumps(Hostile(mark))
    serialized = {":type:": "x", ":serialized:": base64.b64encode(code).decode()}
    with zipfile.ZipFile(saved) as archive:
        data = json.loads(archive.read("data"))
    yield rewrite(saved, {"data": json.dumps({**data, "policy_class": serialized}).encode()})
    yield rewrite(saved, {"data": json.dumps({**data, "policy_class": serialized}).encode(), "flock.json": None})
    for name in ("policy.pth", "actor.optimizer.pth", "pytorch_variables.pth"):
        yield rewrite(saved, {name: code})
        yield rewrite(saved, {name: tensors({}, pickled=code)})
    for name in ("data", "flock.json"):
        yield rewrite(saved, {name: code})


def test_no_code_in_a_file_is_ever_run(saved, tmp_path):
    mark = tmp_path / "owned"
    loaded = 0
    for file in hostile_files(saved, mark):
        try:
            load_policy(file)
            loaded += 1
        except PolicyError as error:
            assert "\n" not in str(error)  # noqa: PT017 - both outcomes are accepted
        assert not mark.exists()
    assert loaded >= 5  # members that inference does not need are not read


def test_the_hostile_files_run_their_code_with_trust(saved, tmp_path):
    mark = tmp_path / "owned"
    first = next(hostile_files(saved, mark))
    with pytest.raises(PolicyError, match="SB3 cannot load it either"):  # the code left no policy class
        load_policy(first, trust=True)
    assert mark.exists()


def test_with_trust_sb3_loads_the_file(model, saved):
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    trusted = load_policy(saved, trust=True)
    assert trusted.config == SMALL_MODEL
    np.testing.assert_array_equal(trusted.predict(observations)[0], load_policy(saved).predict(observations)[0])


def bombs(saved):
    """Small files that would unpack, or be built, to gigabytes."""
    with zipfile.ZipFile(saved) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    zeros = b"\0" * 2**20

    def bomb(name, changes, **kwargs):
        path = saved.with_name(f"{name}.zip")
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            for part, content in {**parts, **changes}.items():
                if content is None:
                    with file.open(zipfile.ZipInfo(part), "w") as member:
                        member._compressor = zipfile._get_compressor(zipfile.ZIP_DEFLATED)
                        member._zinfo.compress_type = zipfile.ZIP_DEFLATED
                        for _ in range(300):
                            member.write(zeros)
                else:
                    file.writestr(part, content, **kwargs)
        return path

    yield bomb("large", {"policy.pth": None})
    lying = bomb("lying", {"policy.pth": None})
    lying.write_bytes(lying.read_bytes().replace((300 * 2**20).to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    yield lying
    inner = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(tensors({"x": th.zeros(1)}))) as old,
        zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, 300 * zeros if name.endswith("data/0") else old.read(name))
    yield bomb("inner", {"policy.pth": inner.getvalue()})
    yield bomb("lzma", {}, compress_type=zipfile.ZIP_LZMA)
    member = json.loads(parts["flock.json"])
    wide = {
        "channels": [65536, 65536],
        "kernel_size": 15,
        "features_dim": 65536,
        "n_critics": 32,
        "net_arch": [65536, 65536],
    }
    member["config"]["network"].update(wide)
    member["config"]["scenario"]["n_anchors"] = 101
    yield bomb("wide", {"flock.json": json.dumps(member)})
    promised = tensors({"actor.mu.0.weight": th.empty(2**20, 2**20, device="meta")})
    yield bomb("promised", {"flock.json": json.dumps(member), "policy.pth": promised})
    yield bomb("deep", {"flock.json": "[" * 10**6})
    yield bomb("digits", {"flock.json": '{"format": ' + "9" * 10**6 + "}"})
    view = th.zeros(1).expand(10**12)
    yield bomb("view", {"policy.pth": tensors(dict.fromkeys(("actor.mu.0.bias", "actor.mu.0.weight"), view))})


def test_bombs_are_refused_within_bounds(saved):
    pytest.importorskip("resource", reason="memory is measured as POSIX does")
    code = """
import resource, sys, time
from sb3_flock import load_policy
from sb3_flock.serialization.load import PolicyError
from sb3_flock.settings import ActionError
load_policy(sys.argv[1])
before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
for path in sys.argv[2:]:
    try:
        load_policy(path)
    except PolicyError as error:
        print(error)
megabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / (1024 if sys.platform == "linux" else 2**20)
assert megabytes < 200, megabytes
"""
    files = [str(path) for path in bombs(saved)]
    assert all(os.path.getsize(path) < 3e6 for path in files)
    done = subprocess.run(
        [sys.executable, "-c", code, str(saved), *files], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == files


def test_members_with_names_outside_the_folder_are_not_written(saved, tmp_path):
    with zipfile.ZipFile(saved, "a") as archive:
        archive.writestr("../outside", "x")
        archive.writestr("/tmp/../outside", "x")
    load_policy(saved)
    assert {path.name for path in tmp_path.iterdir()} == {"policy.zip"}


def test_an_error_quotes_a_file_without_control_characters(model, saved):
    state = {**model.policy.state_dict(), "actor.\x1b[2J": th.zeros(1)}
    with pytest.raises(PolicyError) as error:
        load_policy(rewrite(saved, {"policy.pth": tensors(state)}))
    assert str(error.value).isprintable()


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
@pytest.mark.parametrize(
    ("policy", "kwargs"),
    [
        (FlockPolicy, {}),
        (FlockPolicy, {"action_bound": "tanh", "net_arch": [32, 16], "features_extractor_kwargs": {"layer_norm": False}}),
        (
            "MlpPolicy",
            {"features_extractor_class": FlockCNN, "net_arch": [24], "features_extractor_kwargs": {"features_dim": 8}},
        ),
    ],
)
def test_files_of_plain_sb3_with_our_parts_load_without_trust(tmp_path, algorithm, policy, kwargs):
    plain = algorithm(policy, make_vec_env(SMALL_MODEL.scenario, seed=0), policy_kwargs=kwargs, buffer_size=10, seed=0)
    for parameter in plain.policy.parameters():
        parameter.data.mul_(3)  # away from the small initial values, so that the bounds matter
    plain.save(tmp_path / "plain.zip")
    with pytest.warns(UserWarning, match="the default is assumed"):
        loaded, trusted = (load_policy(tmp_path / "plain.zip", trust=trust) for trust in (False, True))
    observations = np.random.default_rng(0).random((50, 3, 11, 11)).astype(np.float32)
    expected = plain.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observations)[0], expected)
    np.testing.assert_array_equal(trusted.predict(observations)[0], expected)
    for read in (loaded, trusted):  # SB3 saves no task: the paper's is assumed, which has no filter
        assert (read.scenario.safety_filter, read.scenario.shared_detections) == ("off", False)
        assert read.scenario == Scenario(max_turn_rate=read.scenario.max_turn_rate, max_speed=read.scenario.max_speed)


@pytest.mark.parametrize("trust", [False, True])
def test_motion_channels_in_a_file_of_plain_sb3_are_assumed_to_be_those_of_our_configs(tmp_path, trust):
    scenario = SMALL_MODEL.scenario.replace(motion_lag=0.2)
    plain = DDPG(FlockPolicy, make_vec_env(scenario, seed=0), buffer_size=10, seed=0)
    plain.save(tmp_path / "plain.zip")
    with pytest.warns(UserWarning, match="the default is assumed"):
        loaded = load_policy(tmp_path / "plain.zip", trust=trust)
    assert loaded.scenario.motion_lag == 0.2
    assert evaluate(loaded, episodes=1)["return"].n == 1


def test_files_of_plain_sb3_with_other_parts_need_trust(tmp_path):
    plain = DDPG("MlpPolicy", make_vec_env(SMALL_MODEL.scenario, seed=0), policy_kwargs={"net_arch": [8]}, buffer_size=10)
    plain.save(tmp_path / "plain.zip")
    with pytest.raises(PolicyError, match="trust"):
        load_policy(tmp_path / "plain.zip")
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    with pytest.warns(UserWarning, match="the default is assumed"):
        trusted = load_policy(tmp_path / "plain.zip", trust=True)
    np.testing.assert_array_equal(trusted.predict(observations)[0], plain.predict(observations, deterministic=True)[0])


def test_loading_and_evaluating_imports_neither_torchs_compiler_nor_what_trains_or_plots():
    """Importing torch's compiler takes a second; a torch optimizer imports it, and so do operations on the meta device."""
    code = """
import sys
from sb3_flock import evaluate, load_policy
policy = load_policy("ddpg")
evaluate(policy, policy.scenario.replace(max_cycles=2), episodes=1)
slow = {"torch._dynamo", "sympy", "matplotlib", "pandas", "supersuit", "onnx", "ray", "sb3_flock.training.train"}
sys.exit(f"imported: {slow & set(sys.modules)}" if slow & set(sys.modules) else 0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_policy_that_computes_nan_is_refused_in_one_line(saved):
    policy = load_policy(saved)
    observations = np.zeros((4, 3, 11, 11), np.float32)
    observations[2] = np.nan
    with pytest.raises(ActionError, match=r"^action of vehicle 2 = \[nan, nan\]: finite numbers are needed$"):
        policy.predict(observations)
    with pytest.raises(ActionError, match=r"^action = \[nan, nan\]: finite numbers are needed$"):
        policy.predict(observations[2])


# -- learning on -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "n_flocks"), [("ddpg", 1), ("ddpg", 4), ("flock", 2)])
def test_a_shipped_policy_learns_on_with_any_number_of_slots(name, n_flocks):
    policy = load_policy(name)
    env = make_vec_env(policy.scenario.replace(n_vehicles=4), n_flocks, seed=0)
    model = policy.to_model(env, learning_starts=40, buffer_size=2000, batch_size=16)
    assert isinstance(model, FlockDDPG)
    observations = env.reset()
    np.testing.assert_allclose(
        model.predict(observations, deterministic=True)[0], policy.predict(observations)[0], atol=1e-6
    )
    critics = model.critic.state_dict()
    assert all(th.equal(tensor, critics[key]) for key, tensor in policy.policy.critic.state_dict().items())
    assert model.gradient_steps == max(1, round(policy.config.algorithm.utd_ratio * env.num_envs))
    assert (model.bc_coef, model.replay_buffer.expert_actions) == (0.0, None)
    model.learn(60)
    assert len(model.action_noise.noises) == env.num_envs
    assert model._n_updates > 0
    assert np.abs(model.predict(observations, deterministic=True)[0] - policy.predict(observations)[0]).max() > 0
    assert policy.policy.actor is not model.actor


def test_behavior_cloning_stays_with_an_expert_that_is_queried():
    policy = load_policy("flock")
    model = policy.to_model(
        expert_vec_env(policy.scenario), learning_starts=12, buffer_size=2000, batch_size=8, learning_rate=1e-5
    )
    assert model.bc_coef == policy.config.algorithm.bc_coef > 0
    assert model.lr_schedule(1.0) == 1e-5
    model.learn(30)
    assert model._n_updates > 0


def test_what_does_not_fit_the_policy_is_refused_in_one_line(saved, tmp_path):
    policy = load_policy(saved)
    wrong = [
        (Scenario(n_anchors=9), "its observations of shape (3, 11, 11) and actions in"),
        (Scenario(max_speed=0.3), "are not the env's"),
    ]
    for scenario, line in wrong:
        with pytest.raises(PolicyError, match=re.escape(line)):
            policy.to_model(make_vec_env(scenario, 1))
    with pytest.raises(PolicyError, match="trained without VecNormalize"):
        policy.to_model(VecNormalize(make_vec_env(n_flocks=1)))
    with pytest.raises(SettingsError, match="color is not a parameter"):
        policy.to_model(make_vec_env(policy.scenario, 1), color="red")
    with pytest.raises(SettingsError, match="algo and the networks are those of the file"):
        policy.to_model(make_vec_env(policy.scenario, 1), features_dim=32)
    with pytest.warns(UserWarning, match="link_range = 0.15, evaluated with 0.2"):
        policy.to_model(make_vec_env(policy.scenario.replace(link_range=0.2), 1))
    plain = tmp_path / "plain.zip"
    DDPG(FlockPolicy, make_vec_env(n_flocks=1), buffer_size=10, device="cpu").save(plain)
    with pytest.warns(UserWarning, match="saved without its scenario"):
        policy = load_policy(plain)
    with pytest.raises(PolicyError, match="saved without a config of its networks"):
        policy.to_model(make_vec_env(n_flocks=1))
