"""``sb3-flock sweep``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

from sb3_flock.cli import shared
from sb3_flock.cli.messages import errors_of
from sb3_flock.cli.parsing import FAILED, INTERRUPTED, Parser, count
from sb3_flock.errors import SettingsError


def add(parser: Parser) -> None:
    """Add the arguments."""
    from sb3_flock.config.training import TrainingConfig

    parser.describe(
        "configs/sweep_lambda.yaml --set total_timesteps=20000",
        description="Train at every point of a grid or a search, as many at once as there are cores; rank the settings.",
        renamed={"--out": "--output"},
    )
    parser.add_argument("file", nargs="?", metavar="FILE", help="YAML file: what to vary, over which config")
    parser.add_argument(
        "--resume",
        metavar="DIR",
        help="continue the sweep in this folder: unfinished and failed trials from their last checkpoints; Ray keeps its "
        "state as pickles, which run any code in them, so resume your own sweeps only",
    )
    parser.add_argument(
        "--evaluate", metavar="POLICY", help=f"evaluate this policy at every point instead: {shared.POLICY_HELP}"
    )
    parser.add_argument("-n", "--episodes", type=count(1), metavar="N", help="episodes a point, with --evaluate [1000]")
    parser.add_argument("--address", metavar="ADDRESS", help="a running Ray cluster's, or auto [this machine alone]")
    shared.add_output(
        parser,
        "new folder, shared by the cluster's machines, or a URL such as s3://... [sweeps/FILE_<k>]",
        metavar="DIR",
    )
    parser.add_set("total_timesteps=20000, for every trial", TrainingConfig)


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Run or resume the sweep, and print the ranking."""
    from sb3_flock.sweep.config import load_sweep
    from sb3_flock.sweep.run import default_out, resume_sweep, sweep

    if (options.file is None) == (options.resume is None):
        raise SettingsError("sweep: a FILE or --resume DIR is needed, and not both")
    if options.resume is not None:
        given = [flag for flag in ("evaluate", "episodes", "output", "set") if getattr(options, flag)]
        if given:
            raise SettingsError(f"--resume and --{given[0]}: the sweep's folder has a config of its own")
        with errors_of("--address", options.address), errors_of("--resume", options.resume):
            config, trials = resume_sweep(options.resume, options.address)
        output = options.resume
    else:
        flags = (("policy", options.evaluate), ("episodes", options.episodes))
        changes = {name: value for name, value in flags if value is not None}
        config = load_sweep(options.file, shared.overrides_of(options.set), **changes)
        if options.episodes is not None and config.policy is None:
            raise SettingsError(f"--episodes {options.episodes}: only with --evaluate; a training has n_test_episodes")
        output = options.output or default_out(options.file)
        with errors_of("--address", options.address), errors_of("--output", output):
            trials = sweep(config, output, options.address)
    return _report(config, trials, output)


def _report(config: Any, trials: Sequence[Any], output: str) -> int:
    from sb3_flock.console import PlainConsole
    from sb3_flock.sweep.statistics import report

    console = PlainConsole()
    for table in report(config, trials, output):
        console.print(table)
    for trial in trials:
        if trial.why:
            print(f"sb3-flock: {trial.name}: {trial.status}: {trial.why}", file=sys.stderr)
    print(output)
    ended = Counter(trial.status for trial in trials)
    if open_ones := ended["failed"] + ended["unfinished"]:
        print(f"sb3-flock: {open_ones} trials did not end; to continue: sb3-flock sweep --resume {output}", file=sys.stderr)
        return INTERRUPTED if ended["unfinished"] else FAILED
    return 0
