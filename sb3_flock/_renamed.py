"""Names of the previous release, and what they are called now: every old name works for one release, with a warning.

This module and :mod:`sb3_flock.serialization.migrate` are the only places that know old names.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import operator
import sys
import warnings
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any


class RenamedWarning(FutureWarning):
    """A name of the previous release was used."""


FIELDS: dict[str, dict[str, str]] = {
    "Scenario": {"look_back": "motion_lag"},
    "TrainingConfig": {
        "practice": "train_env",
        "learner": "algorithm",
        "eval_episodes": "n_eval_episodes",
        "test_episodes": "n_test_episodes",
    },
    "TrainEnvConfig": {
        "vehicles": "flock_sizes",
        "obstacle_arena_ratio": "obstacle_arena_scale",
        "time_step_ratio": "time_step_scale",
        "separation_ratio": "separation_scale",
        "obstacle_separation_ratio": "obstacle_separation_scale",
        "teacher": "expert",
        "teacher_share": "expert_fraction",
        "teacher_noise": "expert_noise_std",
        "foresight": "mpc",
    },
    "MPCConfig": {
        "reach": "max_link_length",
        "slack": "link_cutoff",
        "reach_weight": "link_weight",
        "sight": "obstacle_visibility",
        "steps": "horizon",
        "rounds": "n_iterations",
        "pace": "step_size",
    },
    "AlgorithmConfig": {
        "guidance": "bc_coef",
        "mirror": "mirror_augmentation",
        "update_ratio": "utd_ratio",
        "noise": "action_noise_std",
        "final_noise": "final_action_noise_std",
    },
    "FlockDDPG": {"guidance": "bc_coef"},
    "CompactReplayBuffer": {"mirror": "mirror_augmentation", "advice": "store_expert_actions"},
}
"""Old to new names of parameters, by the class that has them."""

VALUES: dict[tuple[str, str], dict[str, str]] = {
    ("TrainingConfig", "algo"): {"ddpg-stock": "ddpg-sb3"},
    ("TrainEnvConfig", "expert"): {"foresight": "mpc"},
}
"""Old to new values, by class and parameter."""

POLICIES = {
    **{f"{old}-{task}": "ddpg" for old in ("paper", "ddpg") for task in ("3v1o", "5v1o", "5v2o")},
    **{f"{old}-{task}": "flock" for old in ("second-look", "ddpg-bc") for task in ("3v1o", "5v1o", "5v2o")},
    "general": "flock",
    "crossing-5v2o": "flock",
}
"""Earlier shipped policies, and those that replaced them."""

_MODULES = {
    "evaluation.compare": "viz.compare",
    "evaluation.controllers": "controllers",
    "evaluation.controllers.descent": "controllers.mpc_kernels",
    "evaluation.controllers.foresight": "controllers.mpc",
    "evaluation.controllers.motion": "controllers.motion",
    "evaluation.controllers.olfati_saber": "controllers.olfati_saber",
    "evaluation.controllers.orca": "controllers.orca",
    "evaluation.controllers.simple": "controllers.waypoint",
    "evaluation.episodes": "evaluation.rollout",
    "evaluation.figures": "viz.figures",
    "evaluation.film": "viz.video",
    "envs.demonstrations": "envs.expert_env",
    "envs.side_by_side": "envs.multi_flock",
    "play": "viz.play",
    "rl.algorithms": "rl.registry",
    "rl.checkpoints": "training.checkpoint",
    "rl.config": "config.training",
    "rl.config_io": "serialization.yaml_io",
    "rl.extractor": "rl.torch_layers",
    "rl.loading": "serialization.load",
    "rl.logs": "training.logger",
    "rl.onboard": "deploy.onnx_export",
    "rl.policy": "rl.policies",
    "rl.progress": "training.progress_callback",
    "rl.replay": "rl.buffers",
    "rl.run_folder": "training.run_dir",
    "rl.safety": "training.signals",
    "rl.saving": "serialization.save",
    "rl.selection": "training.eval_callback",
    "rl.training": "training.train",
}
"""Old to new modules of ``sb3_flock``."""

_MEMBERS = {
    "AdvisedSamples": "rl.buffers:ExpertReplayBufferSamples",
    "EARLIER_INPUTS": "deploy.onnx_export:PREVIOUS_INPUTS",
    "Export": "deploy.onnx_export:ExportResult",
    "FILMS": "viz.video:VIDEO_WRITERS",
    "Flight": "viz.figures:Trajectory",
    "LINK": "controllers.mpc_kernels:UNIT_LINK",
    "Picture": "viz.video:Frame",
    "Situation": "deploy.onnx_check:SampleInput",
    "Teacher": "controllers.base:Controller",
    "Wants": "controllers.mpc_kernels:CostParams",
    "check_film": "viz.video:check_video",
    "curves_figure": "viz.compare:plot_curves",
    "descend": "controllers.mpc_kernels:optimize",
    "flights": "viz.figures:plot_side_by_side",
    "inexactness": "training.checkpoint:reproducibility_warnings",
    "locked": "training.run_dir:lock_run_dir",
    "new_run_folder": "training.run_dir:create_run_dir",
    "observation": "viz.figures:plot_observation",
    "random_situations": "deploy.onnx_check:random_sample_inputs",
    "slope": "controllers.mpc_kernels:cost_gradient",
    "surroundings": "training.checkpoint:runtime_info",
    "told_once": "training.logger:quiet_writer_thread",
    "write_whole": "serialization.save:atomic_write",
    "Checkpoints": "training.checkpoint_callback:CheckpointCallback",
    "Controller": "controllers.base:Controller",
    "DemonstratedActions": "rl.callbacks:StoreExecutedActions",
    "DemonstratedEnv": "envs.expert_env:ExpertEnv",
    "DivergedError": "rl.callbacks:DivergedError",
    "Evaluation": "training.eval_callback:FlockEvalCallback",
    "FadingNoise": "rl.callbacks:LinearNoiseDecay",
    "FlockCNN": "serialization.format2:FlockCNNOfFormat2",
    "FlockPolicy": "serialization.format2:FlockPolicyOfFormat2",
    "FlockSACPolicy": "serialization.format2:FlockSACPolicyOfFormat2",
    "FiniteLosses": "rl.callbacks:StopOnNonFiniteLoss",
    "FlockProgress": "training.progress_callback:FlockProgressCallback",
    "Foresight": "controllers.mpc:MPC",
    "ForesightGains": "controllers.mpc:MPCConfig",
    "LearnerConfig": "rl.settings:AlgorithmConfig",
    "NetworkConfig": "rl.settings:NetworkConfig",
    "Onboard": "deploy.onnx_export:OnnxPolicy",
    "PolicyController": "controllers.policy:PolicyController",
    "PracticeConfig": "config.training:TrainEnvConfig",
    "RandomController": "controllers.random:RandomController",
    "SideBySide": "envs.multi_flock:MultiFlockEnv",
    "Signals": "training.signals:GracefulShutdown",
    "TEACHERS": "controllers:EXPERTS",
    "_FlattenByAnchor": "rl.torch_layers:_FlattenByAnchor",
    "as_controller": "evaluation.rollout:as_controller",
    "fly": "evaluation.rollout:rollout",
    "fly_one": "evaluation.rollout:iter_rollout",
    "fly_together": "evaluation.rollout:rollout_batch",
    "lines": "viz.figures:plot_lines",
    "record": "viz.figures:record_trajectory",
    "shipped_policies": "pretrained:shipped_policies",
    "trajectories": "viz.figures:plot_trajectories",
}
"""Old members of those modules to new ones, where name or module changed by more than the module itself."""

_MEMBERS_OF_KEPT_MODULES = {
    "evaluation": {
        "Controller": "controllers.base:Controller",
        "PolicyController": "controllers.policy:PolicyController",
        "fly": "evaluation.rollout:rollout",
    },
    "rl.callbacks": {
        "DemonstratedActions": "rl.callbacks:StoreExecutedActions",
        "FadingNoise": "rl.callbacks:LinearNoiseDecay",
    },
    "sim": {"sense": "sim.world:World.sense"},
}
"""Old members of modules whose names stay."""


def warn_renamed(what: str, now: str, stacklevel: int = 2) -> None:
    """One line that names the new name.

    :param stacklevel: as in :func:`warnings.warn`, counted from the caller
    """
    warnings.warn(f"{what} is now {now}; the old name works for one release", RenamedWarning, stacklevel=stacklevel + 1)


def current_policy(name: str, stacklevel: int = 2) -> str:
    """The name of the shipped policy that replaced one of an earlier release, with a warning; other names as they are.

    :param stacklevel: as in :func:`warn_renamed`
    """
    if name not in POLICIES:
        return name
    new = POLICIES[name]
    text = f"policy {name} is now {new}, with its own task and the safety filter; the old name works for one release"
    warnings.warn(text, RenamedWarning, stacklevel=stacklevel + 1)
    return new


def rename_fields(owner: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """The parameters of one class under their present names, and what was renamed as (old, new) pairs.

    :param owner: the class's name
    """
    fields, renamed, current = FIELDS.get(owner, {}), [], {}
    for name, value in values.items():
        new = fields.get(name, name)
        if new != name and new in values:
            new = name  # both are given: the old one is refused as unknown
        if new != name:
            renamed.append((name, new))
        meaning = VALUES.get((owner, new), {})
        if isinstance(value, str) and value in meaning:
            renamed.append((f"{new} = {value}", f"{new} = {meaning[value]}"))
            value = meaning[value]  # noqa: PLW2901
        current[new] = value
    return current, renamed


def rename_key(key: str) -> str:
    """A key such as ``practice.vehicles`` or ``vehicles`` with each part under its present name."""
    flat = {old: new for owner in ("Scenario", "TrainingConfig", "TrainEnvConfig", "MPCConfig", "AlgorithmConfig")
            for old, new in FIELDS[owner].items()}  # fmt: skip
    return ".".join(flat.get(part, part) for part in key.split("."))


def renamed_member(module: str, name: str) -> Any:
    """What an old member of a module whose name stays is now; the module's ``__getattr__`` calls this.

    :raises AttributeError: if the module had no such member
    """
    target = _MEMBERS_OF_KEPT_MODULES[module.removeprefix("sb3_flock.")].get(name)
    if target is None:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    now, _, member = target.partition(":")
    warn_renamed(f"{module}.{name}", f"sb3_flock.{now}.{member}", stacklevel=3)
    return operator.attrgetter(member)(importlib.import_module(f"sb3_flock.{now}"))


class _RenamedModule(ModuleType):
    """Stands for a module under its old name; members come from where they are now."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        module, _, member = _MEMBERS.get(name, f"{_MODULES[self.__name__.removeprefix('sb3_flock.')]}:{name}").partition(":")
        return getattr(importlib.import_module(f"sb3_flock.{module}"), member)


class _RenamedModules(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds modules under their old names, for old imports and for the pickles in files that SB3 itself loads."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname.removeprefix("sb3_flock.") not in _MODULES:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=fullname.endswith(".controllers"))

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        warn_renamed(spec.name, f"sb3_flock.{_MODULES[spec.name.removeprefix('sb3_flock.')]}", stacklevel=3)
        return _RenamedModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing to run."""


def install() -> None:
    """Let old module names be imported."""
    if not any(isinstance(finder, _RenamedModules) for finder in sys.meta_path):
        sys.meta_path.insert(0, _RenamedModules())  # first: an old folder with caches may be left in a checkout
