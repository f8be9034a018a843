import argparse

import pytest

from sb3_flock.cli.shared import load_trusted_or_not, overrides_of, rollout_of
from sb3_flock.controllers.waypoint import GoToWaypoint
from sb3_flock.serialization.load import LoadedPolicy
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario


def options(**given):
    values = {
        "command": "evaluate", "policy": None, "controller": None, "n_vehicles": None, "n_obstacles": None,
        "obstacle_motion": None, "simulator": None, "device": "cpu", "trust": False, "set": [],
    }  # fmt: skip
    return argparse.Namespace(**{**values, **given})


def test_a_policy_brings_its_scenario_and_flags_change_it():
    policy, name, scenario = rollout_of(options(policy="ddpg", n_vehicles=7, set=["arena=2"]))
    assert isinstance(policy, LoadedPolicy)
    assert name.endswith("ddpg.zip")
    assert scenario == policy.scenario.replace(n_vehicles=7, arena=2.0)
    assert policy.scenario.n_vehicles == 5


def test_a_controller_starts_from_the_default_scenario():
    controller, name, scenario = rollout_of(options(controller="go-to-waypoint", obstacle_motion="crossing"))
    assert isinstance(controller, GoToWaypoint)
    assert (name, scenario) == ("go-to-waypoint", Scenario(obstacle_motion="crossing"))


@pytest.mark.parametrize("given", [{}, {"policy": "flock", "controller": "orca"}])
def test_exactly_one_of_them_is_needed(given):
    with pytest.raises(SettingsError, match="evaluate: a POLICY or --controller NAME is needed, and not both"):
        rollout_of(options(**given))


def test_an_assignment_that_is_none_names_the_flag():
    assert overrides_of(["reward.lambda_=0.5", "seed=1e2"]) == {"reward.lambda_": 0.5, "seed": 100}
    with pytest.raises(SettingsError, match="^--set seed: KEY=VALUE is needed"):
        overrides_of(["seed"])


def test_trust_is_never_silent(saved, capsys):
    load_trusted_or_not(str(saved), "cpu", False)
    assert capsys.readouterr().err == ""
    load_trusted_or_not(str(saved), "cpu", True)
    assert capsys.readouterr().err == "sb3-flock: warning: --trust runs any code that is in the policy file\n"
