"""Arguments that several commands have, and what the commands do with them."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from sb3_flock.cli.messages import errors_of
from sb3_flock.cli.parsing import Parser, count, listed, whole_number
from sb3_flock.errors import SettingsError

if TYPE_CHECKING:
    import argparse
    from pathlib import Path

    from rich.console import Console

POLICY_HELP = "a zip, a run folder (its best_model.zip) or a shipped policy's name, such as flock"


def add_output(parser: Parser, what: str, metavar: str = "FILE", **kwargs: Any) -> None:
    """The flag of every file or folder that a command writes."""
    parser.add_argument("-o", "--output", metavar=metavar, help=what, **kwargs)


def add_trust(parser: Parser) -> None:
    """The flag that lets SB3 load a policy."""
    parser.add_argument("--trust", action="store_true", help="let SB3 load the policy, which runs any code in the file")


def add_speed(parser: Parser) -> None:
    """The flag of the playback speed."""
    parser.add_argument("--speed", type=float, default=2.0, metavar="X", help="times real time [2]")


def add_rollout(parser: Parser) -> None:
    """Which controller, in which scenario: the same for every command that simulates."""
    from sb3_flock.controllers import CONTROLLERS
    from sb3_flock.sim import Scenario
    from sb3_flock.sim.simulators import SIMULATORS

    parser.add_argument("policy", nargs="?", metavar="POLICY", help=POLICY_HELP)
    parser.add_argument("--controller", metavar="NAME", help=f"a baseline controller instead: {listed(CONTROLLERS)}")
    parser.add_argument("--n-vehicles", metavar="N", type=whole_number, help="number of vehicles [as trained]")
    parser.add_argument("--n-obstacles", metavar="N", type=whole_number, help="number of obstacles [as trained]")
    parser.add_argument("--obstacle-motion", metavar="NAME", help="walk or crossing [as trained]")
    parser.add_argument("--simulator", metavar="NAME", help=f"move the vehicles in another simulator: {listed(SIMULATORS)}")
    parser.add_argument("--seed", type=count(0), default=0, metavar="N", help="seed of the episodes [0]")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="torch device [cpu]")
    add_trust(parser)
    parser.add_set("obstacle_arena=0.5", Scenario, "them all, under scenario")


ROLLOUT_RENAMED = {"--scenario": "--obstacle-motion"}
"""Old to new flags of :func:`add_rollout`."""


def rollout_of(options: argparse.Namespace) -> tuple[Any, str, Any]:
    """The policy or controller, its name, and the scenario."""
    from sb3_flock.serialization.yaml_io import load_config
    from sb3_flock.settings import suggest
    from sb3_flock.sim import Scenario
    from sb3_flock.sim.simulators import SIMULATORS

    if (options.policy is None) == (options.controller is None):
        raise SettingsError(f"{options.command}: a POLICY or --controller NAME is needed, and not both")
    controller: Any
    if options.policy is None:
        from sb3_flock.controllers import make_controller

        controller, name, trained_for = make_controller(options.controller), options.controller, Scenario()
    else:
        controller = load_trusted_or_not(options.policy, options.device, options.trust)
        name, trained_for = str(controller.path), controller.scenario
    overrides = overrides_of(options.set)
    flags = ("n_vehicles", "n_obstacles", "obstacle_motion")
    overrides.update({key: value for key in flags if (value := getattr(options, key)) is not None})
    if options.simulator is not None:
        if options.simulator not in SIMULATORS:
            known = f"one of {listed(SIMULATORS)} is needed{suggest(options.simulator, SIMULATORS)}"
            raise SettingsError(f"--simulator {options.simulator}: {known}")
        overrides["dynamics"] = options.simulator
    return controller, name, load_config(Scenario, overrides=overrides, base=trained_for)


def overrides_of(assignments: list[str]) -> dict[str, Any]:
    """The values of ``--set``."""
    from sb3_flock.serialization.yaml_io import parse_overrides

    overrides: dict[str, Any] = {}
    for assignment in assignments:
        with errors_of("--set", assignment):
            overrides.update(parse_overrides([assignment]))
    return overrides


def load_trusted_or_not(path: str | Path, device: str = "cpu", trust: bool = False) -> Any:
    """A policy, with a warning if code in its file may run; torch is set to one thread, which small networks are fastest with."""
    import torch as th

    from sb3_flock.serialization.load import load_policy

    if trust:
        print("sb3-flock: warning: --trust runs any code that is in the policy file", file=sys.stderr)
    th.set_num_threads(1)
    return load_policy(path, device, trust)


def evaluate_and_print(controller: Any, name: str, scenario: Any, episodes: int, seed: int, console: Console) -> Any:
    """Evaluate, print the table, and return the metrics."""
    from sb3_flock.console import PlainConsole
    from sb3_flock.evaluation import evaluate
    from sb3_flock.evaluation.report import metrics_table

    with console.status(f"simulating {episodes} episodes"):
        metrics = evaluate(controller, scenario, episodes, seed)
    print(f"{name}:")
    print(f"{scenario.bodies}, {episodes} episodes, seed {seed}")
    PlainConsole().print(metrics_table(metrics, scenario))
    return metrics
