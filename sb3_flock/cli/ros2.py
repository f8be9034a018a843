"""``sb3-flock ros2``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sb3_flock.cli import shared
from sb3_flock.cli.parsing import Parser, count


def add(parser: Parser) -> None:
    """Add the arguments."""
    from sb3_flock.sim import Scenario

    parser.describe(
        "flock --vehicle 0 --ros-args -p n_vehicles:=8",
        description="Drive one vehicle by a policy, as a node of ROS 2: poses in, velocities out. It runs until Ctrl-C, and "
        "stops the vehicle when a pose is lost. docs/ros2.md lists the topics and parameters.",
        usage="%(prog)s [-h] --vehicle I [--trust] [--set KEY=VALUE] POLICY\n       [--ros-args ...]",
    )
    parser.add_argument("policy", metavar="POLICY", help=shared.POLICY_HELP)
    parser.add_argument("--vehicle", type=count(0), required=True, metavar="I", help="number of the vehicle, from 0")
    shared.add_trust(parser)
    parser.add_set("safety_filter=heading", Scenario, "them all, under scenario")
    parser.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        help="arguments of ROS, such as -p n_vehicles:=8; these come last",
    )


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Run the node, and print how long its decisions took."""
    from sb3_flock.deploy.ros2_node import drive
    from sb3_flock.serialization.yaml_io import load_config
    from sb3_flock.sim import Scenario

    policy = shared.load_trusted_or_not(options.policy, trust=options.trust)
    scenario = load_config(Scenario, overrides=shared.overrides_of(options.set), base=policy.scenario)
    print(drive(policy, scenario, options.vehicle, options.ros_args), file=sys.stderr)
    return 0
