"""The ``sb3-flock`` command: words to calls. A command imports what it needs when it runs, so that ``--help`` is quick."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_flock.settings import RunError, SettingsError, UserError, field_of

if TYPE_CHECKING:
    from rich.console import Console

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130

# Flags of `train` that are config fields: the field's path and the flag's metavar; the help is the field's description.
_TRAIN_FLAGS = {
    "--n-vehicles": ("scenario.n_vehicles", "N"),
    "--n-obstacles": ("scenario.n_obstacles", "N"),
    "--scenario": ("scenario.obstacle_motion", "NAME"),
    "--total-timesteps": ("total_timesteps", "N"),
    "--seed": ("seed", "N"),
    "--algo": ("algo", "NAME"),
    "--n-flocks": ("n_flocks", "N"),
    "--device": ("device", "NAME"),
    "--output-dir": ("output_dir", "DIR"),
    "--eval-freq": ("eval_freq", "N"),
    "--save-freq": ("save_freq", "N"),
    "--init-from": ("init_from", "POLICY"),
}

_POLICY_HELP = "a zip, a run folder (its best_model.zip) or a shipped policy's name, such as ddpg-5v2o"
_CONTROLLERS = ("random", "go-to-waypoint", "olfati-saber", "orca")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    :param arguments: the words after ``sb3-flock``; the default is the process's own
    :return: the exit code: 0, 2 after a user's mistake (told in one line on stderr), 1 if the disk, a worker or a training
        fails or nobody reads the output, 130 after Ctrl-C
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    options = parser.parse_args(words)
    try:
        return int(options.run(options, words))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        print("sb3-flock: interrupted", file=sys.stderr)
        return INTERRUPTED
    except UserError as error:
        print(f"sb3-flock: {error}", file=sys.stderr)
        return USAGE_ERROR
    except MemoryError as error:
        print(f"sb3-flock: not enough memory: {' '.join(str(error).split()) or 'something is too large'}", file=sys.stderr)
        return FAILED
    except RunError as error:
        print(f"sb3-flock: {error}", file=sys.stderr)
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="sb3-flock",
        description="Vehicles that flock by reinforcement learning.",
        epilog="example: sb3-flock train --n-vehicles 5 --n-obstacles 2",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and stop")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_train(commands)
    _add_evaluate(commands)
    _add_render(commands)
    _add_play(commands)
    _add_export(commands)
    _add_compare(commands)
    _add_reproduce(commands)
    _add_sweep(commands)
    _add_config(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """argparse with errors in our one line, and no guessing of abbreviated flags."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(allow_abbrev=False, **kwargs)

    def error(self, message: str) -> Any:
        self.exit(USAGE_ERROR, f"{self.prog}: {UserError(message)} (try {self.prog} --help)\n")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"sb3-flock {version('sb3_flock')}")
        parser.exit()


def _add_set(parser: argparse.ArgumentParser, example: str) -> None:
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help=f"change any other field, such as {example}; `sb3-flock config` lists them all",
    )


# -- train -----------------------------------------------------------------------------------------------------------


def _add_train(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train a policy",
        description="Train one shared policy and leave a run folder.",
        epilog="example: sb3-flock train --n-vehicles 5 --n-obstacles 2 --set reward.lambda_=0.5",
    )
    parser.add_argument(
        "--resume",
        metavar="RUN",
        help="go on with this run folder from its newest whole checkpoint; of the other flags only those that leave alone "
        "what it learns are accepted, and a larger --total-timesteps",
    )
    _add_config_flags(parser)
    parser.set_defaults(run=_train)


def _add_config_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE", help="YAML file of parameters; flags below win over it")
    for flag, (path, metavar) in _TRAIN_FLAGS.items():
        parser.add_argument(flag, dest=path, metavar=metavar, help=_field_help(path))
    _add_set(parser, "reward.lambda_=0.5")


def _field_help(path: str) -> str:
    """A config field's own description and default."""
    from sb3_flock.config.training import TrainingConfig

    field = field_of(TrainingConfig, path)
    default = "" if field.default is None else f" [{field.default}]"
    return f"{field.description}{default}".replace("%", "%%")


def _config_of(options: argparse.Namespace) -> Any:
    from sb3_flock.config.training import TrainingConfig
    from sb3_flock.serialization.yaml_io import load_config

    return load_config(TrainingConfig, options.config, _overrides_of(options))


def _overrides_of(options: argparse.Namespace) -> dict[str, Any]:
    from sb3_flock.serialization.yaml_io import parse_overrides

    flags = {path: value for path, _ in _TRAIN_FLAGS.values() if (value := getattr(options, path)) is not None}
    return {**flags, **parse_overrides(options.set)}


def _train(options: argparse.Namespace, words: Sequence[str]) -> int:
    from rich.console import Console

    console = Console(stderr=True)
    # The training is imported after the config is read: a mistake in it is told without waiting for torch.
    if options.resume is None:
        config = _config_of(options)
        from sb3_flock.training.train import train

        result = train(config, console, command=["sb3-flock", *words])
    else:
        if options.config is not None:
            raise SettingsError("--resume and --config: the run folder has a config of its own")
        changes = _overrides_of(options)
        from sb3_flock.training.train import resume

        result = resume(options.resume, console, changes, command=["sb3-flock", *words])
    from sb3_flock.serialization.load import load_policy

    policy = load_policy(result.best_model)
    episodes = result.config.n_test_episodes
    _evaluate_and_print(policy, str(policy.path), result.config.scenario, episodes, seed=0, console=console)
    print(result.folder)
    return 0


# -- evaluate --------------------------------------------------------------------------------------------------------


def _add_evaluate(commands: Any) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="fly a policy and print its metrics",
        description="Fly a saved policy through many episodes at once and print every metric with its interval.",
        epilog="example: sb3-flock evaluate runs/ddpg_5v2o_1 --n-vehicles 8 --json result.json",
    )
    _add_flight_flags(parser)
    parser.add_argument("--episodes", type=_count(1), default=1000, metavar="N", help="episodes to fly [1000]")
    parser.add_argument("--json", metavar="FILE", help="write the metrics to this file, too")
    parser.add_argument("--sensors", action="store_true", help="show how noise, missed detections and delay tell on it, too")
    parser.set_defaults(run=_evaluate)


def _add_flight_flags(parser: argparse.ArgumentParser) -> None:
    """Who flies, and where: the same for every command that flies."""
    parser.add_argument("policy", nargs="?", metavar="POLICY", help=_POLICY_HELP)
    parser.add_argument("--controller", metavar="NAME", help=f"fly a hand-written law instead: {', '.join(_CONTROLLERS)}")
    parser.add_argument("--n-vehicles", dest="n_vehicles", metavar="N", help="number of vehicles [as trained]")
    parser.add_argument("--n-obstacles", dest="n_obstacles", metavar="N", help="number of obstacles [as trained]")
    parser.add_argument("--scenario", dest="obstacle_motion", metavar="NAME", help="walk or crossing [as trained]")
    parser.add_argument("--seed", type=_count(0), default=0, metavar="N", help="seed of the episodes [0]")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="torch device [cpu]")
    _add_trust(parser)
    _add_set(parser, "obstacle_arena=0.5")


def _add_trust(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--trust", action="store_true", help="let SB3 load the policy, which runs any code in the file")


def _flight_of(options: argparse.Namespace) -> tuple[Any, str, Any]:
    """Who flies, its name, and the scenario."""
    from sb3_flock.serialization.yaml_io import load_config, parse_overrides
    from sb3_flock.sim import Scenario

    if (options.policy is None) == (options.controller is None):
        raise SettingsError(f"{options.command}: a POLICY or --controller NAME is needed, and not both")
    flyer: Any
    if options.policy is None:
        from sb3_flock.controllers import make_controller

        flyer, name, trained_for = make_controller(options.controller), options.controller, Scenario()
    else:
        flyer = _load_policy(options.policy, options.device, options.trust)
        name, trained_for = str(flyer.path), flyer.scenario
    overrides = parse_overrides(options.set)
    flags = ("n_vehicles", "n_obstacles", "obstacle_motion")
    overrides.update({key: value for key in flags if (value := getattr(options, key)) is not None})
    return flyer, name, load_config(Scenario, overrides=overrides, base=trained_for)


def _load_policy(path: str, device: str, trust: bool) -> Any:
    from sb3_flock.serialization.load import load_policy

    if trust:
        print("sb3-flock: warning: --trust runs any code that is in the policy file", file=sys.stderr)
    with _warnings_told():
        return load_policy(path, device, trust)


def _count(least: int) -> Any:
    def integer(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: an integer of at least {least} is needed")
        return value

    return integer


def _evaluate(options: argparse.Namespace, words: Sequence[str]) -> int:
    from rich.console import Console

    if options.json is not None and not Path(options.json).absolute().parent.is_dir():
        raise SettingsError(f"--json {options.json}: there is no folder {Path(options.json).parent}")
    flyer, name, scenario = _flight_of(options)
    console = Console(stderr=True)
    metrics = _evaluate_and_print(flyer, name, scenario, options.episodes, options.seed, console)
    if options.sensors:
        from sb3_flock.evaluation.robustness import errors_table, evaluate_with_errors

        with console.status("flying with sensors that err"):
            Console().print(errors_table(evaluate_with_errors(flyer, scenario, options.episodes, options.seed)))
    if options.json is not None:
        from sb3_flock.evaluation.report import write_json
        from sb3_flock.serialization.save import versions

        meta = {
            **({"controller": name} if options.policy is None else flyer.describe()),
            "episodes": options.episodes,
            "seed": options.seed,
            "scenario": scenario.model_dump(mode="json"),
            "evaluated_with": versions(),
        }
        with _disk_errors_told(f"--json {options.json}"):
            write_json(options.json, metrics, meta)
    return 0


def _evaluate_and_print(flyer: Any, name: str, scenario: Any, episodes: int, seed: int, console: Console) -> Any:
    import torch as th
    from rich.console import Console as RichConsole

    from sb3_flock.evaluation import evaluate
    from sb3_flock.evaluation.report import metrics_table

    th.set_num_threads(1)
    with _warnings_told(), console.status(f"flying {episodes} episodes"):
        metrics = evaluate(flyer, scenario, episodes, seed)
    print(f"{name}:")
    print(f"{scenario.bodies}, {episodes} episodes, seed {seed}")
    RichConsole().print(metrics_table(metrics, scenario))
    return metrics


@contextlib.contextmanager
def _warnings_told() -> Iterator[None]:
    """Warnings as lines of ours."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield
    for warning in caught:
        print(f"sb3-flock: warning: {warning.message}", file=sys.stderr)


@contextlib.contextmanager
def _disk_errors_told(what: str) -> Iterator[None]:
    """A file that cannot be written is a user's mistake, in one line."""
    try:
        yield
    except OSError as error:
        raise SettingsError(f"{what}: {error.strerror or error}") from None


# -- render ----------------------------------------------------------------------------------------------------------


def _add_render(commands: Any) -> None:
    parser = commands.add_parser(
        "render",
        help="fly one episode and write a picture, a film or a web page",
        description="Fly one episode and write it: .gif, .mp4 and .html move, .png and .svg show the paths.",
        epilog="example: sb3-flock render ddpg-5v2o --out flight.html --episode 3",
    )
    _add_flight_flags(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help="file to write; its name's end says the kind")
    parser.add_argument("--episode", type=_count(0), default=0, metavar="N", help="number of the seed's episode [0]")
    _add_speed(parser)
    parser.set_defaults(run=_render)


def _render(options: argparse.Namespace, words: Sequence[str]) -> int:
    import torch as th
    from rich.console import Console

    from sb3_flock.viz.video import check_video, render

    check_video(Path(options.out), options.speed)
    flyer, name, scenario = _flight_of(options)
    th.set_num_threads(1)
    title = f"{options.policy or name}: {scenario.bodies}, episode {options.episode} of seed {options.seed}"
    with _warnings_told(), Console(stderr=True).status("flying"), _disk_errors_told(f"--out {options.out}"):
        path = render(flyer, scenario, options.out, options.seed, options.episode, options.speed, title)
    print(path)
    return 0


# -- play ------------------------------------------------------------------------------------------------------------


def _add_play(commands: Any) -> None:
    parser = commands.add_parser(
        "play",
        help="fly live in a window, with mouse and keys",
        description="Fly live in a window: drag the waypoint, drop obstacles, add vehicles, see what one of them sees.",
        epilog="example: sb3-flock play general --n-vehicles 8",
    )
    _add_flight_flags(parser)
    _add_speed(parser)
    parser.set_defaults(run=_play)


def _add_speed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--speed", type=float, default=2.0, metavar="X", help="times real time [2]")


def _play(options: argparse.Namespace, words: Sequence[str]) -> int:
    import torch as th

    from sb3_flock.viz.play import play

    th.set_num_threads(1)
    flyer, _, scenario = _flight_of(options)
    with _warnings_told():
        play(flyer, scenario, options.seed, options.speed)
    return 0


# -- export ----------------------------------------------------------------------------------------------------------


def _add_export(commands: Any) -> None:
    parser = commands.add_parser(
        "export",
        help="write a policy as ONNX, for a vehicle's computer",
        description="Write a policy as an ONNX graph from measured positions to speed and turn rate, and check it.",
        epilog="example: sb3-flock export ddpg-5v2o policy.onnx",
    )
    parser.add_argument("policy", metavar="POLICY", help=_POLICY_HELP)
    parser.add_argument("out", metavar="FILE", help="file to write, such as policy.onnx")
    _add_trust(parser)
    parser.set_defaults(run=_export)


def _export(options: argparse.Namespace, words: Sequence[str]) -> int:
    import torch as th

    from sb3_flock.deploy.onnx_export import export

    th.set_num_threads(1)
    policy = _load_policy(options.policy, "cpu", options.trust)
    with _disk_errors_told(f"export {options.out}"):
        done = export(policy, options.out)
    print(
        f"differs from the policy by at most {done.difference:.1g} of the range in {done.situations} situations; "
        f"{1000 * done.latency:.3f} ms a decision (median, one core)",
        file=sys.stderr,
    )
    print(done.path)
    return 0


# -- compare ---------------------------------------------------------------------------------------------------------


def _add_compare(commands: Any) -> None:
    parser = commands.add_parser(
        "compare",
        help="show trainings side by side",
        description="Print the best evaluations of trainings and what differs in their configs; plot their curves.",
        epilog="example: sb3-flock compare runs/ddpg_5v2o_1 runs/ddpg_5v2o_2 --out curves.png",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--out", metavar="FILE", help="plot the evaluations to this .png or .svg, too")
    parser.set_defaults(run=_compare)


def _compare(options: argparse.Namespace, words: Sequence[str]) -> int:
    from rich.console import Console

    from sb3_flock.viz.compare import differences_table, load_runs, plot_curves, results_table
    from sb3_flock.viz.figures import check_figure_file, save_as

    if options.out is not None:
        check_figure_file(Path(options.out))
    runs = load_runs(options.runs)
    console = Console()
    console.print(results_table(runs))
    differences = differences_table(runs)
    if differences is not None:
        console.print(differences)
    if options.out is not None:
        with _disk_errors_told(f"--out {options.out}"):
            save_as(plot_curves(runs), Path(options.out), Path(options.out).suffix[1:])
        print(options.out)
    return 0


# -- reproduce -------------------------------------------------------------------------------------------------------


def _add_reproduce(commands: Any) -> None:
    parser = commands.add_parser(
        "reproduce",
        help="make the paper's tables and figures with ours",
        description="Fly the shipped policies and the hand-written laws; write the paper's tables and figures with ours.",
        epilog="example: sb3-flock reproduce --quick --out results",
    )
    parser.add_argument("--out", default="results", metavar="DIR", help="folder to write to [results]")
    parser.add_argument("--quick", action="store_true", help="100 episodes a row instead of 1000, the rest shortened alike")
    parser.set_defaults(run=_reproduce)


def _reproduce(options: argparse.Namespace, words: Sequence[str]) -> int:
    import torch as th

    from sb3_flock.reproduce import reproduce

    th.set_num_threads(1)
    print(reproduce(options.out, options.quick))
    return 0


# -- sweep -----------------------------------------------------------------------------------------------------------


def _add_sweep(commands: Any) -> None:
    parser = commands.add_parser(
        "sweep",
        help="train, or fly a policy, at many settings at once, on one machine or a Ray cluster",
        description="Train at every point of a grid or a search, as many at once as the cores carry; rank the settings.",
        epilog="example: sb3-flock sweep configs/sweep_lambda.yaml --set total_timesteps=20000",
    )
    parser.add_argument("file", nargs="?", metavar="FILE", help="YAML file that says what to vary, over which config")
    parser.add_argument(
        "--resume",
        metavar="DIR",
        help="go on with the sweep in this folder: unfinished and failed trials from their last checkpoints; Ray keeps its "
        "state as pickles, which run any code in them, so go on with your own sweeps only",
    )
    parser.add_argument("--evaluate", metavar="POLICY", help=f"fly this policy at every point instead: {_POLICY_HELP}")
    parser.add_argument("--episodes", type=_count(1), metavar="N", help="episodes a point, with --evaluate [1000]")
    parser.add_argument("--address", metavar="ADDRESS", help="a running Ray cluster's, or auto [this machine alone]")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="new folder, shared by the cluster's machines, or a URL such as s3://... [sweeps/FILE_<k>]",
    )
    _add_set(parser, "total_timesteps=20000, for every trial")
    parser.set_defaults(run=_sweep)


def _sweep(options: argparse.Namespace, words: Sequence[str]) -> int:
    from sb3_flock.serialization.yaml_io import parse_overrides
    from sb3_flock.sweep.config import load_sweep
    from sb3_flock.sweep.run import default_out, resume_sweep, sweep

    if (options.file is None) == (options.resume is None):
        raise SettingsError("sweep: a FILE or --resume DIR is needed, and not both")
    if options.resume is not None:
        given = [flag for flag in ("evaluate", "episodes", "out", "set") if getattr(options, flag)]
        if given:
            raise SettingsError(f"--resume and --{given[0]}: the sweep's folder has a config of its own")
        config, trials = resume_sweep(options.resume, options.address)
        out = options.resume
    else:
        flags = (("policy", options.evaluate), ("episodes", options.episodes))
        changes = {name: value for name, value in flags if value is not None}
        config = load_sweep(options.file, parse_overrides(options.set), **changes)
        if options.episodes is not None and config.policy is None:
            raise SettingsError(f"--episodes {options.episodes}: only with --evaluate; a training has n_test_episodes")
        out = options.out or default_out(options.file)
        trials = sweep(config, out, options.address)
    return _report_sweep(config, trials, out)


def _report_sweep(config: Any, trials: Sequence[Any], out: str) -> int:
    from rich.console import Console

    from sb3_flock.sweep.statistics import report

    console = Console()
    for table in report(config, trials, out):
        console.print(table)
    for trial in trials:
        if trial.why:
            print(f"sb3-flock: {trial.name}: {trial.status}: {trial.why}", file=sys.stderr)
    print(out)
    ended = Counter(trial.status for trial in trials)
    if open_ones := ended["failed"] + ended["unfinished"]:
        print(f"sb3-flock: {open_ones} trials did not end; to go on: sb3-flock sweep --resume {out}", file=sys.stderr)
        return INTERRUPTED if ended["unfinished"] else FAILED
    return 0


# -- config ----------------------------------------------------------------------------------------------------------


def _add_config(commands: Any) -> None:
    parser = commands.add_parser(
        "config",
        help="print a training's whole config, every key explained",
        description="Print the config that `train` would run with the same flags, as YAML with a comment on every key.",
        epilog="example: sb3-flock config --n-vehicles 5 > mine.yaml",
    )
    _add_config_flags(parser)
    parser.set_defaults(run=_print_config)


def _print_config(options: argparse.Namespace, words: Sequence[str]) -> int:
    from sb3_flock.serialization.yaml_io import to_yaml

    print(to_yaml(_config_of(options)), end="")
    return 0
