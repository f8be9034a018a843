"""``sb3-flock train``."""

from __future__ import annotations

import argparse
import contextlib
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sb3_flock.cli import shared
from sb3_flock.cli.parsing import Parser, listed, whole_number
from sb3_flock.errors import RunError, SettingsError
from sb3_flock.settings import field_of

if TYPE_CHECKING:
    from rich.console import Console

    from sb3_flock.training.train import TrainingResult

CONFIG_FLAGS: dict[str, tuple[tuple[str, ...], str]] = {
    "scenario.n_vehicles": (("--n-vehicles",), "N"),
    "scenario.n_obstacles": (("--n-obstacles",), "N"),
    "scenario.obstacle_motion": (("--obstacle-motion",), "NAME"),
    "total_timesteps": (("-n", "--total-timesteps", "--n-timesteps"), "N"),
    "seed": (("--seed",), "N"),
    "algo": (("--algo",), "NAME"),
    "train_env.expert": (("--expert",), "NAME"),
    "n_flocks": (("--n-flocks",), "N"),
    "device": (("--device",), "NAME"),
    "output_dir": (("-f", "--output-dir", "--log-folder"), "DIR"),
    "eval_freq": (("--eval-freq",), "N"),
    "save_freq": (("--save-freq",), "N"),
    "init_from": (("-i", "--init-from", "--trained-agent"), "POLICY"),
}
"""Fields of the training config that are flags: the flags (the short ones and the aliases are rl_zoo3's) and their metavar."""

RENAMED = {"--scenario": "--obstacle-motion"}


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "--n-vehicles 5 --set reward.lambda_=0.5",
        description="Train one shared policy and leave a run folder.",
        renamed=RENAMED,
    )
    parser.add_argument(
        "--resume",
        metavar="RUN",
        help="continue this run folder from its newest whole checkpoint; accepts a larger --total-timesteps, and otherwise "
        "only flags that do not change what is learned",
    )
    add_config_flags(parser)


def add_config_flags(parser: Parser) -> None:
    """The flags that make a training config."""
    from sb3_flock.config.training import TrainingConfig

    parser.add_argument("--config", metavar="FILE", help="YAML file of parameters; the flags below override it")
    for path, (flags, metavar) in CONFIG_FLAGS.items():
        kind = whole_number if metavar == "N" else str
        parser.add_argument(*flags, dest=path, metavar=metavar, type=kind, help=_help(path))
    parser.add_set("reward.lambda_=0.5", TrainingConfig)


def _help(path: str) -> str:
    """A field's own description and default; more for the fields that need it."""
    from sb3_flock.config.presets import EXPERT_PRESETS
    from sb3_flock.config.training import TrainEnvConfig, TrainingConfig
    from sb3_flock.controllers import EXPERTS
    from sb3_flock.rl.registry import ALGORITHMS

    field = field_of(TrainingConfig, path)
    text, _, null = (field.description or "").partition("; null: ")
    if path == "algo":
        text = f"learning algorithm: {listed(ALGORITHMS)}"
    elif path == "train_env.expert":
        presets = listed(EXPERT_PRESETS)
        text = f"expert to learn from: {listed(EXPERTS)}; {presets} also sets what such a training needs (`sb3-flock config "
        text += (
            f"--expert {presets}` shows it), unless the config file or other flags do; the others set train_env.expert alone"
        )
    elif path == "scenario.n_vehicles":
        sizes = listed(map(str, TrainEnvConfig().flock_sizes or ()))
        text = f"number of vehicles of the task (paper: 3 or 5); the training env has flocks of {sizes}, unless "
        text += "--expert mpc or --set train_env.flock_sizes=null"
    null = null.removesuffix(" (paper: null)")
    return f"{text} [{null if field.default is None else field.default}]".replace("%", "%%")


def config_of(options: argparse.Namespace) -> Any:
    """The training config that the flags make; the preset of ``--expert`` gives way to the file and all other flags."""
    from sb3_flock.config.presets import EXPERT_PRESETS
    from sb3_flock.config.training import TrainingConfig
    from sb3_flock.serialization.yaml_io import load_config

    preset = EXPERT_PRESETS.get(getattr(options, "train_env.expert"))
    return load_config(TrainingConfig, options.config, _overrides_of(options), defaults=preset)


def _overrides_of(options: argparse.Namespace) -> dict[str, Any]:
    flags = {path: value for path in CONFIG_FLAGS if (value := getattr(options, path)) is not None}
    return {**flags, **shared.overrides_of(options.set)}


@contextlib.contextmanager
def _resume_as_command() -> Iterator[Any]:
    """A console for the training; where the library says that a folder can be resumed, it and errors show the command."""
    from sb3_flock.console import PlainConsole

    class CommandConsole(PlainConsole):
        def print(self, *objects: Any, **kwargs: Any) -> None:
            super().print(*(_as_command(line) if isinstance(line, str) else line for line in objects), **kwargs)

    try:
        yield CommandConsole(stderr=True)
    except RunError as error:
        raise type(error)(_as_command(str(error))) from None


def _as_command(line: str) -> str:
    return re.sub(r"; resume (.+) to continue$", r"; to continue: sb3-flock train --resume \1", line)


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Train or resume, and print the table of the best policy and the run folder."""
    with _resume_as_command() as console:
        result = _train_or_resume(options, words, console)
    policy = shared.load_trusted_or_not(result.best_model)
    episodes = result.config.n_test_episodes
    shared.evaluate_and_print(policy, str(policy.path), result.config.scenario, episodes, seed=0, console=console)
    print(result.folder)
    return 0


def _train_or_resume(options: argparse.Namespace, words: Sequence[str], console: Console) -> TrainingResult:
    # The training is imported after the config is read: a mistake in the config is reported without waiting for torch.
    if options.resume is None:
        config = config_of(options)
        from sb3_flock.training.train import train

        return train(config, console, command=["sb3-flock", *words])
    if options.config is not None:
        raise SettingsError("--resume and --config: the run folder has a config of its own")
    changes = _overrides_of(options)
    from sb3_flock.training.train import resume

    return resume(options.resume, console, changes, command=["sb3-flock", *words])
