"""A user's type checker, without the package's own settings; and what help() and dir() show."""

import subprocess
import sys
from pathlib import Path

import sb3_flock
from sb3_flock import Scenario, TrainingConfig

ROOT = Path(__file__).parents[1]

SCRIPT = """
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_flock import (
    CompactReplayBuffer, DropDeadTransitions, FlockDDPG, FlockEvalCallback, FlockPolicy, NeighborInclusiveReward, RewardWeights,
    Scenario, TrainingConfig, VecNeighborInclusiveReward, evaluate, flatten, flocking_v0, load_policy, make_controller,
    make_vec_env, policy_path, render, save_model, train,
)

scenario = Scenario(n_vehicles=4, reward={"lambda_": 0.5})
other = Scenario(reward=RewardWeights(lambda_=0.5)).replace(n_obstacles=2)
config = TrainingConfig(scenario=scenario, total_timesteps=100, algorithm={"learning_rate": 1e-3})
env = make_vec_env(other, n_flocks=2, seed=0, monitor=True)
n: int = env.n_agents + scenario.n_vehicles
model = FlockDDPG(FlockPolicy, env, replay_buffer_class=CompactReplayBuffer)
model.learn(100, callback=[NeighborInclusiveReward(0.7), FlockEvalCallback(scenario, 100)])
PPO("MlpPolicy", VecNormalize(VecNeighborInclusiveReward(VecMonitor(env)))).learn(10, callback=DropDeadTransitions())
policy = load_policy("ddpg")
print(evaluate(policy, scenario, episodes=10)["tracking_error"].mean)
save_model(policy.to_model(env, learning_rate=1e-4), "policy.zip", config)
DDPG.load(policy_path("ddpg"), env)
render(policy, scenario, "flight.gif")
parallel = flocking_v0.parallel_env(n_vehicles=3, render_mode="rgb_array")
observations, infos = parallel.reset(seed=0)
parallel.step({agent: (0.1, 0.0) for agent in parallel.agents})
flatten(parallel, n_copies=2, seed=0).env_method("render")
print(train(TrainingConfig(algo="td3", network={"features_dim": 16})).best_model, config.model_dump())
evaluate(make_controller("orca"), other)
wrong: str = scenario.n_vehicles
"""
"""Its last line alone is wrong."""


def test_a_users_script_and_the_examples_have_types(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "mypy.ini").write_text("[mypy]\n[mypy-mpe2.*,onnxruntime.*,pettingzoo.*]\nignore_missing_imports = true\n")
    examples = sorted(map(str, (ROOT / "examples").glob("*.py")))
    words = ["--config-file", "mypy.ini", "--follow-imports", "silent", "--no-error-summary", "script.py", *examples]
    environment = {"MYPYPATH": str(ROOT), "PATH": ""}
    run = [sys.executable, "-m", "mypy", *words]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    (found,) = done.stdout.splitlines() or [done.stderr]
    assert found.startswith(f"script.py:{SCRIPT.count(chr(10))}: error: Incompatible types in assignment"), done.stdout


def test_help_shows_every_field_with_its_meaning():
    for settings in (Scenario, TrainingConfig):
        shown = settings.__doc__
        assert shown.splitlines()[0].endswith(".")
        for name, field in settings.model_fields.items():
            assert f"\n:param {name}: {field.description}" in shown
    assert Scenario.__doc__.count(":param reward:") == 1


def test_dir_shows_the_public_names_alone():
    names = [name for name in dir(sb3_flock) if not name.startswith("__")]
    assert names == sorted(sb3_flock.__all__)
    assert all(hasattr(sb3_flock, name) for name in dir(sb3_flock))
