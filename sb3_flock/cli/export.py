"""``sb3-flock export``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sb3_flock.cli import shared
from sb3_flock.cli.messages import written_to
from sb3_flock.cli.parsing import Parser
from sb3_flock.errors import SettingsError


def add(parser: Parser) -> None:
    """Add the arguments."""
    from sb3_flock.sim import Scenario

    parser.describe(
        "flock -o policy.onnx",
        description="Write a policy from measured positions to speed and turn rate, and check it: as C99 for a "
        "microcontroller if FILE ends in .c, else as an ONNX graph.",
        usage="%(prog)s [-h] -o FILE [--trust] [--set KEY=VALUE] POLICY",
    )
    parser.add_argument("policy", metavar="POLICY", help=shared.POLICY_HELP)
    parser.add_argument("file", nargs="?", metavar="FILE", help=argparse.SUPPRESS)
    shared.add_output(parser, "file to write, such as policy.onnx or policy.c")
    shared.add_trust(parser)
    parser.add_set("safety_filter=announce", Scenario, "them all, under scenario")


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Export, and print how well the file agrees with the policy."""
    from sb3_flock.deploy import c_export, onnx_export
    from sb3_flock.serialization.yaml_io import load_config
    from sb3_flock.sim import Scenario

    if (options.output is None) == (options.file is None):
        raise SettingsError("export: one -o FILE to write is needed")
    output = options.output or options.file
    policy = shared.load_trusted_or_not(options.policy, trust=options.trust)
    scenario = load_config(Scenario, overrides=shared.overrides_of(options.set), base=policy.scenario)
    export = c_export.export_c if output.endswith(".c") else onnx_export.export
    with written_to("--output", output):
        done = export(policy, output, scenario=scenario)
    if done.n_samples:
        print(
            f"differs from the policy by at most {done.difference:.1g} of the range over {done.n_samples} sample inputs; "
            f"{1000 * done.latency:.3f} ms a decision (median, one core)",
            file=sys.stderr,
        )
    print(done.path)
    return 0
