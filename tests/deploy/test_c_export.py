"""A policy in C acts as policy and filter do, and no vehicle violates a separation; ``-m slow`` takes 10^6 steps."""

import re
import subprocess
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, TD3

from sb3_flock import load_policy, make_vec_env, train
from sb3_flock.cli import main
from sb3_flock.deploy import c_check, c_export
from sb3_flock.deploy.c_check import compiler, library_of
from sb3_flock.deploy.c_export import TOLERANCE, export_c, reserved_margin, source_of
from sb3_flock.deploy.onnx_check import compare, random_sample_inputs
from sb3_flock.serialization.load import LoadedPolicy, PolicyError
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.sim.observation import CHANNELS, Channel, register_channel
from tests.deploy.test_onnx_safety import OnnxFilter, fly_as_the_world_does, simulate
from tests.helpers import SMALL_MODEL, quiet, tiny
from tests.sim.test_safety import DRIVERS, FILTERS, random_task

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler (cc)")


TRACKER = {"enabled": True, "shared_motion": True}


@pytest.fixture
def small(model):
    """A small untrained policy."""
    return LoadedPolicy(Path("small.zip"), model.policy, SMALL_MODEL, {}, 0)


@pytest.fixture
def library(small):
    """A function that compiles a scenario; the libraries stay as long as the test."""
    with ExitStack() as stack:
        yield lambda scenario, *n_bodies: stack.enter_context(library_of(source_of(small, scenario), scenario, *n_bodies))


# -- whole policies ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("ddpg", {}),
        ("ddpg", {"safety_filter": "off", "shared_detections": False}),
        ("flock", {"safety_filter": "motion", "obstacle_filter": True}),
        ("flock", {"safety_filter": "announce", "obstacle_filter": True, "safety_margin": 0.002}),
        ("flock", {}),
        ("flock", {"safety_filter": "heading"}),
        ("flock", {"actuators": {"speed_lag": 0.1, "slip": 0.05}, "obstacle_filter": True}),
        ("flock", {"actuators": {"speed_lag": 0.1, "max_acceleration": 0.3}, "tracker": TRACKER}),
        ("flock", {"safety_filter": "voronoi", "tracker": TRACKER}),
    ],
)
def test_the_compiled_file_acts_as_policy_and_filter_do(name, changes):
    policy = load_policy(name)
    scenario = policy.scenario.replace(**changes)
    with library_of(source_of(policy, scenario), scenario) as library:
        difference, _ = compare(library, policy, scenario, 1000, seed=0, reserve=reserved_margin(scenario))
    assert difference < TOLERANCE


@pytest.mark.parametrize(
    "changes",
    [
        {"algo": "sac"},
        {"algo": "td3", "network.action_bound": "tanh", "scenario.n_anchors": 15, "anchor_width": 1.5},
        {"motion_lag": 0.2, "shared_detections": True, "network.channels": [8], "layer_norm": False},
        {"kernel_size": 2, "stride": 1, "network.channels": [4, 5, 6], "net_arch": [16, 8]},
    ],
)
def test_other_algorithms_networks_and_observations(tmp_path, changes):
    """The weights are as large as those of a trained network."""
    result = train(tiny(tmp_path, **changes), quiet())
    policy = load_policy(result.folder / "final_model.zip")
    with th.no_grad():
        for parameter in policy.policy.actor.parameters():
            parameter.mul_(1.5).add_(0.2 * th.randn(parameter.shape, generator=th.manual_seed(0)))
    done = export_c(policy, tmp_path / "other.c", n_samples=100)
    assert done.difference < 1e-5
    actions = [policy.predict(observation)[0] for _, observation in random_sample_inputs(policy.scenario, 50, seed=0)]
    assert np.std(actions, axis=0).max() > 0.01


@pytest.mark.filterwarnings("ignore:.*trained with shared_detections")
@pytest.mark.parametrize("safety_filter", ["motion", "announce"])
def test_a_flock_of_microcontrollers_flies_as_the_world_does(safety_filter):
    policy = load_policy("flock")
    scenario = policy.scenario.replace(
        safety_filter=safety_filter, obstacle_filter=True, safety_margin=0.01, shared_detections=False
    )
    with library_of(source_of(policy, scenario), scenario) as library:
        # In float32 a neighbor that hardly moves away counts as one that approaches: with `motion` that slows a step down.
        fly_as_the_world_does(library, scenario, policy, tolerance=2e-3 if safety_filter == "motion" else 1e-4)


# -- the filter ----------------------------------------------------------------------------------------------------------


class CFilter(OnnxFilter):
    """The filter of a scenario in C for all vehicles of a world."""

    def __init__(self, scenario, library):
        self.scenario, self.lost, self.library = scenario, 0.0, library
        self.rng = np.random.default_rng(0)

    def __call__(self, world, asked, before):
        sensing, library = world.sense(), self.library
        i, j = sensing.neighbors.observers, sensing.neighbors.vehicles
        inputs, outputs = np.zeros(asked[..., 0].size, library.input), np.zeros(asked[..., 0].size, library.output)
        for name in ("neighbors", "obstacles"):
            contacts = getattr(sensing, name)
            counts = contacts.count().ravel()
            column = np.arange(len(contacts.observers)) - (np.cumsum(counts) - counts)[contacts.observers]
            inputs["now"][f"n_{name}"] = counts
            inputs["now"][name][contacts.observers, column] = contacts.positions
        counts = sensing.neighbors.count().ravel()
        column = np.arange(len(i)) - (np.cumsum(counts) - counts)[i]
        if self.scenario.motion_lag:
            now, then = world.positions.reshape(-1, 2), before.reshape(-1, 2)
            turns = self.rng.uniform(-3, 3, len(now))  # the frame of the time before may have any heading
            headings = world.headings.ravel() - turns
            frames = np.stack((np.cos(headings), np.sin(headings)), axis=-1)

            def in_frames(offsets, rows):
                (x, y), (cos, sin) = offsets.T, frames[rows].T
                return np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)

            inputs["ego_motion"][:, :2], inputs["ego_motion"][:, 2] = in_frames(now - then, slice(None)), turns
            positions = in_frames(then[j] - then[i], i)
            positions[np.linalg.norm(positions, axis=-1) >= self.scenario.link_range] = 1e15
            inputs["previous"]["n_neighbors"] = counts
            inputs["previous"]["neighbors"][i, column] = positions
        if "neighbor_headings" in library.input.fields:
            inputs["neighbor_headings"][i, column] = self._received(world.headings.ravel()[j] - world.headings.ravel()[i])
        outputs["asked_speed"], outputs["asked_turn_rate"] = asked.reshape(-1, 2).T
        assert library.call("flock_filter", inputs, outputs) == [0] * len(inputs)
        if self.scenario.safety_filter == "announce":
            announced = np.zeros((len(inputs), *library.announced.shape), np.float32)
            announced[i, column] = self._received(outputs["announced_speed"][j])
            library.call("flock_raise_speed", inputs, announced, outputs)
            assert (outputs["speed"] >= outputs["announced_speed"]).all()
        return np.stack((outputs["speed"], outputs["turn_rate"]), axis=-1).astype(float).reshape(asked.shape)

    def check(self, world, executed, expected):
        """No vehicle is faster than with the filter in float64, but for the last digit of what it asks for."""
        np.testing.assert_allclose(executed[..., 1], expected[..., 1], rtol=1e-6)
        assert (executed[..., 0] <= expected[..., 0] * (1 + 1e-7) + 1e-37).all()
        moves = expected[..., 0] > 0.1 * self.scenario.max_speed
        self.kept = np.median(executed[moves][:, 0] / expected[moves][:, 0]) if moves.any() else 1.0


@pytest.mark.parametrize("safety_filter", FILTERS)
def test_no_pair_violates_its_separation(safety_filter, library):
    for unit in (3, 4):  # a task of centimeters and another one
        scenario = random_task(np.random.default_rng(unit), 20, safety_filter)
        c_filter = CFilter(scenario, library(scenario, (19, 1)))
        for seed, driver in enumerate(DRIVERS * 2):
            simulate(c_filter, driver, 6, seed, is_packed=seed < len(DRIVERS))
            assert c_filter.kept > 0.99
        c_filter.lost = 0.3  # of the headings and of the announcements
        for seed, driver in enumerate(DRIVERS):
            simulate(c_filter, driver, 6, seed, is_packed=True)


def test_obstacles_that_stand_and_the_margin_are_kept(library):
    scenario = Scenario(
        n_vehicles=8,
        n_obstacles=6,
        safety_filter="announce",
        obstacle_filter=True,
        safety_margin=0.01,
        obstacle_max_speed=0.05,
    )
    c_filter = CFilter(scenario, library(scenario))
    for seed, driver in enumerate(DRIVERS):
        simulate(c_filter, driver, 4, seed, is_packed=False)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_million_vehicle_steps_behind_the_compiled_filter_without_a_violation(small):
    rng, simulated = np.random.default_rng(0), 0
    while simulated < 1_000_000:
        n_vehicles = int(rng.integers(2, 1 + 200 ** rng.uniform(0.2, 1)))
        scenario = random_task(rng, n_vehicles, str(rng.choice(FILTERS)))
        with library_of(source_of(small, scenario), scenario, (n_vehicles, 1)) as library:
            c_filter = CFilter(scenario, library)
            for driver in DRIVERS:
                seed, is_packed = int(rng.integers(2**31)), bool(rng.random() < 0.5)
                simulated += simulate(c_filter, driver, max(1, 100 // n_vehicles), seed, is_packed)


RESERVE = 2 * 0.15 * 2.0**-20 / 0.1
"""What float32's reserve costs in a step of 0.1 s with a link range of 0.15 m [m/s]."""


@pytest.fixture
def announcing(library):
    """One vehicle with ``announce`` that asks for top speed, as a function of its neighbors; speed and announced speed."""
    built = library(Scenario(safety_filter="announce"))

    def run(neighbors=((0.11, 0.0),), headings=(0.0,), announced=(0.1,), asked=0.15):
        inputs = {"neighbors": np.reshape(neighbors, (-1, 2)), "obstacles": np.zeros((0, 2)), "waypoint": np.zeros(2)}
        struct, output = built.struct_of({**inputs, "neighbor_headings": np.array(headings)}), np.zeros(1, built.output)
        received = np.zeros((1, *built.announced.shape), np.float32)
        received[0, : len(announced)] = announced
        output["asked_speed"], output["asked_turn_rate"] = asked, 1.0
        built.call("flock_filter", struct, output)
        built.call("flock_raise_speed", struct, received, output)
        assert output["turn_rate"] == np.float32(1.0)
        return float(output["speed"][0]), float(output["announced_speed"][0])

    return run


@pytest.mark.parametrize(
    ("headings", "announced", "speed"),
    [
        ([0.0], [0.04], 0.14 - RESERVE),
        ([0.0], [0.0], 0.1 - RESERVE),  # as `heading`
        ([0.0], [np.nan], 0.1 - RESERVE),
        ([0.0], [np.inf], 0.1 - RESERVE),
        ([0.0], [-1.0], 0.1 - RESERVE),
        ([np.nan], [0.1], 0.05 - RESERVE),  # as `voronoi`
        ([np.inf], [0.1], 0.05 - RESERVE),
        ([7.0], [0.1], 0.05 - RESERVE),  # more than a full turn: of unknown precision
        ([np.pi], [0.1], 0.05 - RESERVE),
        ([0.0], [99.0], 0.15),
    ],
)
def test_what_is_not_received_or_senseless_is_not_used(announcing, headings, announced, speed):
    found, _ = announcing(headings=headings, announced=announced)
    assert found == pytest.approx(speed, abs=1e-6)


def test_speeds_are_rounded_down(announcing):
    rng = np.random.default_rng(0)
    for distance, angle in rng.uniform((0.1, 0.0), (0.13, 1.5), (200, 2)):
        x, y = np.float32(distance * np.cos(angle)), np.float32(distance * np.sin(angle))
        speed, _ = announcing(neighbors=[(x, y)], announced=[0.0], asked=9.0)
        exact = np.hypot(float(x), float(y))
        assert speed * 0.1 * float(x) / exact <= max(exact - 0.1, 0.0)
        assert speed <= 0.15


def test_a_neighbor_at_the_same_place_or_at_the_separation_stops_the_vehicle(announcing):
    assert announcing(neighbors=[(0.0, 0.0)]) == (0.0, 0.0)
    assert announcing(neighbors=[(0.1, 0.0)], announced=[0.0]) == (0.0, 0.0)
    assert announcing(neighbors=[(-0.1, 0.0)], announced=[0.0])[0] > 0.1  # it recedes


# -- what cannot be read -------------------------------------------------------------------------------------------------


@pytest.fixture
def moving(library):
    """A library of the level ``motion``, and an input with which the vehicle drives."""
    scenario = Scenario(safety_filter="motion", motion_lag=0.2, obstacle_filter=True)
    policy = load_policy("flock")
    with library_of(source_of(policy, scenario), scenario) as built:
        samples = (inputs for inputs, _ in random_sample_inputs(scenario, 100, seed=0))
        for inputs in samples:
            struct, output = built.struct_of(inputs), np.ones(1, built.output)
            if len(inputs["neighbors"]) > 2 and len(inputs["obstacles"]) > 2:
                assert built.call("flock_decide", struct, output) == [0]
                if output["speed"] > 0.05:
                    break
        yield built, struct


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e16])
def test_numbers_that_are_not_readable_stop_the_vehicle(moving, value):
    library, struct = moving
    floats = struct.view(np.float32).reshape(-1)
    read = 0
    for k in range(len(floats)):
        changed = struct.copy()
        changed.view(np.float32).reshape(-1)[k] = value
        output = np.ones(1, library.output)
        (code,) = library.call("flock_decide", changed, output)
        if code:
            assert output["speed"] == output["turn_rate"] == output["asked_speed"] == 0
            read += 1
        else:
            assert 0 < output["speed"] <= 0.15
    points = sum(struct[name][count][0] for name in ("now", "previous") for count in ("n_neighbors", "n_obstacles"))
    assert read == 2 * points + 2 * 2 + 3 + 4  # positions, waypoints, ego-motion, and counts, which become absurd


@pytest.mark.parametrize("count", [-1, 17, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("name", ["n_neighbors", "n_obstacles"])
@pytest.mark.parametrize("measurement", ["now", "previous"])
def test_counts_out_of_bounds_stop_the_vehicle(moving, measurement, name, count):
    library, struct = moving
    struct[measurement][name] = count
    output = np.ones(1, library.output)
    assert library.call("flock_decide", struct, output) == [1]
    assert output["speed"] == 0


def test_rows_of_other_neighbors_before_stop_the_vehicle(moving):
    library, struct = moving
    struct["previous"]["n_neighbors"] -= 1
    output = np.ones(1, library.output)
    assert library.call("flock_decide", struct, output) == [1]


@pytest.mark.parametrize("field", ["asked_speed", "asked_turn_rate"])
def test_a_controller_that_asks_for_nan_stops(moving, field):
    library, struct = moving
    output = np.ones(1, library.output)
    output[field] = np.nan
    assert library.call("flock_filter", struct, output) == [1]
    assert output["speed"] == output["turn_rate"] == 0


def reserving(library, **changes):
    """One vehicle with actuators and estimates, top speed asked, behind a neighbor that stands in front of it."""
    settings = {"actuators": {"speed_lag": 0.1, "max_acceleration": 0.3}, "tracker": TRACKER, **changes}
    built = library(Scenario(safety_filter="announce", **settings))

    def run(own_speed=0.0, std=0.0, distance=0.12, announced=0.0):
        struct, output = np.zeros(1, built.input), np.zeros(1, built.output)
        struct["now"]["n_neighbors"], struct["now"]["neighbors"][0, 0] = 1, (distance, 0.0)
        struct["own_speed"], struct["neighbor_stds"][0, 0], output["asked_speed"] = own_speed, std, 0.15
        code = built.call("flock_filter", struct, output)
        built.call("flock_raise_speed", struct, np.full((1, *built.announced.shape), announced, np.float32), output)
        return code[0], float(output["speed"][0]), float(output["announced_speed"][0])

    return run


def test_a_vehicle_keeps_its_way_to_stop_and_the_uncertainty_of_estimates(library):
    """The way of u dt + v lag + v^2 / (2 a), or of u (dt + v / a) + v lag - v^2 / (2 a), fits the gap of 0.02 m."""
    run, v = reserving(library), 0.09
    speeds = [(0.02 - 0.1 * v - v * v / 0.6) / 0.1, (0.02 - 0.1 * v + v * v / 0.6) / (0.1 + v / 0.3)]
    code, speed, announced = run(own_speed=v)
    assert (code, speed) == (0, pytest.approx(max(min(speeds), 0.0), abs=1e-5))
    assert announced == speed
    assert run(own_speed=0.0)[1:] == (pytest.approx(0.15, abs=1e-6), 0.0)  # it has no speed yet to announce
    assert run(own_speed=0.0, std=0.0075)[1] == pytest.approx(0.05, abs=1e-5)
    assert run(own_speed=0.0, std=0.0075, announced=0.04)[1] == pytest.approx(0.09, abs=1e-5)
    assert run(std=np.nan)[1] == 0.0
    for unreadable in (np.nan, -0.1, 1e16):
        assert run(own_speed=unreadable)[:2] == (1, 0.0)


def test_a_vehicle_reaches_the_speed_that_it_has_announced(library):
    """Also if its memory is damaged between the two stages."""
    built = library(Scenario(safety_filter="announce"))
    struct, output = np.zeros(1, built.input), np.zeros(1, built.output)
    output["asked_speed"] = 0.1
    assert built.call("flock_filter", struct, output) == [0]
    struct["now"]["waypoint"] = np.nan
    built.call("flock_raise_speed", struct, np.zeros((1, *built.announced.shape), np.float32), output)
    assert output["speed"] == output["announced_speed"] == np.float32(0.1)


# -- the file ------------------------------------------------------------------------------------------------------------


def compile_with(folder, *words):
    """Run the C compiler in a folder."""
    return subprocess.run([compiler(), "-std=c99", *words], cwd=folder, capture_output=True, text=True, check=False)


def test_the_same_policy_gives_the_same_bytes(small, tmp_path):
    first, second = (export_c(small, tmp_path / name, n_samples=5).path.read_bytes() for name in ("a.c", "b.c"))
    assert first == second
    assert b"$" not in first
    assert b"//:" not in first


def test_the_comment_says_what_a_vehicle_needs_and_no_name_ends_it(small, tmp_path):
    named = replace(small, path=Path("*/ #error in the name ??/ /*"), versions={"torch": "*/ #error"})
    scenario = small.scenario.replace(safety_filter="announce", safety_margin=0.01, shared_detections=True)
    text = source_of(named, scenario)
    comment = text[: text.index("*/")]
    for words in (
        '"safety_filter": "announce"',
        '"safety_margin": 0.01',
        "body frame",
        "flock_raise_speed",
        '"time_step": 0.1',
    ):
        assert words in comment
    assert text[text.index("*/") :].startswith("*/\n#ifndef FLOCK_POLICY_H")
    assert "or one of its neighbors detects" in text
    with library_of(text, scenario):
        pass


@pytest.mark.parametrize("safety_filter", ["off", "announce"])
def test_a_program_includes_the_declarations_and_needs_nothing_else(small, tmp_path, safety_filter):
    (tmp_path / "policy.c").write_text(source_of(small, small.scenario.replace(safety_filter=safety_filter)))
    (tmp_path / "main.c").write_text(
        '#define FLOCK_DECLARATIONS_ONLY\n#include "policy.c"\n'
        "int main(void)\n{\n    static FlockInput input;\n    FlockOutput output;\n"
        "    return flock_decide(&input, &output) == FLOCK_OK && output.speed >= 0.0f ? 0 : 1;\n}\n"
    )
    assert compile_with(tmp_path, *c_check.FLAGS, "-DFLOCK_MAX_NEIGHBORS=3", "main.c", "policy.c", "-lm").stderr == ""
    assert subprocess.run([tmp_path / "a.out"], check=False).returncode == 0
    compile_with(tmp_path, "-c", "-O0", "policy.c")  # optimized, glibc has a sincosf
    symbols = subprocess.run(["nm", "-u", "policy.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    needed = set(re.findall(r"U (\w+)", symbols)) - {"_GLOBAL_OFFSET_TABLE_"}
    assert needed <= {"expf", "sqrtf", "cosf", "sinf", "memset", "memcpy"}


def test_the_program_in_the_documentation_compiles(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "deploy.md").read_text(encoding="utf-8")
    policy = load_policy("flock")
    (tmp_path / "policy.c").write_text(source_of(policy, policy.scenario.replace(safety_filter="announce")))
    (tmp_path / "vehicle.c").write_text(page.split("```c\n")[1].split("```")[0])
    assert compile_with(tmp_path, *c_check.FLAGS, "-c", "vehicle.c").stderr == ""


@pytest.mark.parametrize(("turn", "speed"), [(0.0, 0.1), (3.0, 0.1), (7.0, 0.05), (1e9, 0.05)])
def test_a_motion_counts_unless_the_own_turn_is_of_unknown_precision(library, turn, speed):
    built = library(Scenario(safety_filter="motion", motion_lag=0.2))
    struct, output = np.zeros(1, built.input), np.zeros(1, built.output)
    struct["now"]["n_neighbors"] = struct["previous"]["n_neighbors"] = 1
    struct["now"]["neighbors"][0, 0] = (0.11, 0.0)
    struct["previous"]["neighbors"][0, 0] = (0.105 * np.cos(turn), 0.105 * np.sin(turn))
    struct["ego_motion"], output["asked_speed"] = (0.0, 0.0, turn), 9.0
    assert built.call("flock_filter", struct, output) == [0]
    assert output["speed"] == pytest.approx(speed, rel=1e-3)


def test_fast_math_is_refused(small, tmp_path):
    (tmp_path / "policy.c").write_text(source_of(small, small.scenario))
    assert "compile without -ffast-math" in compile_with(tmp_path, "-c", "-ffast-math", "policy.c").stderr


def test_weights_are_constant_and_activations_are_static(tmp_path):
    policy = load_policy("flock")
    (tmp_path / "policy.c").write_text(source_of(policy, policy.scenario.replace(safety_filter="announce")))
    compile_with(tmp_path, "-c", "-O2", "-fstack-usage", "policy.c")
    text, data, bss = (
        subprocess.run(["size", "policy.o"], cwd=tmp_path, capture_output=True, text=True, check=True)
        .stdout.split("\n")[1]
        .split()[:3]
    )
    n_weights = sum(tensor.numel() for tensor in policy.policy.actor.parameters())
    assert 4 * n_weights < int(text) < 4 * n_weights + 10_000
    assert int(data) == 0
    assert 4 * (726 + 800) <= int(bss) < 4 * (726 + 800) + 64
    frames = [int(line.split("\t")[1]) for line in (tmp_path / "policy.su").read_text().splitlines()]
    assert sum(frames) < 2000


# -- mistakes ------------------------------------------------------------------------------------------------------------


def test_networks_and_channels_without_c_are_one_line(small, tmp_path, restored):
    path = tmp_path / "policy.c"
    env = make_vec_env(small.scenario, 1, seed=0)
    with pytest.raises(SettingsError, match="C is written for FlockCNN with ReLU, .* not for FlattenExtractor"):
        export_c(replace(small, policy=TD3("MlpPolicy", env, buffer_size=10).policy), path)
    with pytest.raises(SettingsError, match="DDPG, TD3 or SAC is needed, not ActorCriticPolicy"):
        export_c(replace(small, policy=PPO("MlpPolicy", env).policy), path)
    restored(CHANNELS)
    register_channel(Channel("ahead", "neighbors", lambda settings: settings.link_range, lambda points: points[:, 0] > 0))
    with pytest.raises(SettingsError, match="channel 'ahead' selects bodies by a function of Python, which has no C"):
        source_of(small, small.scenario.replace(extra_channels=("ahead",)))
    with pytest.raises(SettingsError, match=f"there is no folder {tmp_path / 'no'}$"):
        export_c(small, tmp_path / "no" / "policy.c")
    with pytest.raises(PolicyError, match="its observations have the shape"):
        export_c(small, path, scenario=small.scenario.replace(motion_lag=0.2))
    assert not path.exists()


def test_a_file_that_acts_otherwise_or_does_not_compile_is_not_written(small, tmp_path, monkeypatch):
    right = c_export.source_of
    monkeypatch.setattr(c_export, "source_of", lambda *_: right(*_).replace("\n    speed = ", "\n    speed = 0.01f + "))
    with pytest.raises(RunError, match="differs from the policy by 0.067 of the range, more than 0.0001"):
        export_c(small, tmp_path / "policy.c", n_samples=30)
    monkeypatch.setattr(c_export, "source_of", lambda *_: "no C")
    with pytest.raises(RunError, match="the C compiler failed: .*error"):
        export_c(small, tmp_path / "policy.c", n_samples=3)
    assert not list(tmp_path.iterdir())


def test_without_a_compiler_the_file_is_written_with_a_warning(small, tmp_path, monkeypatch):
    monkeypatch.setattr(c_export, "compiler", lambda: None)
    with pytest.warns(UserWarning, match="not compared with the policy, because there is no C compiler"):
        done = export_c(small, tmp_path / "policy.c")
    assert done.n_samples == 0
    assert done.path.stat().st_size > 10_000


def test_the_command_writes_c_for_a_name_that_ends_in_c(tmp_path, capsys):
    path = tmp_path / "policy.c"
    assert main(["export", "ddpg", "-o", str(path), "--set", "safety_filter=voronoi"]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{path}\n"
    assert re.match(
        r"differs from the policy by at most \de-0\d of the range over 1000 sample inputs; 0\.\d+ ms", printed.err
    )
    assert '"safety_filter": "voronoi"' in path.read_text()
