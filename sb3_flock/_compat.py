"""Every private attribute of SB3, SuperSuit and Ray that this package touches from outside their classes.

Each function here has a contract test in ``tests/test_compat.py``, which says what breaks if the attribute changes; the
dependencies' versions are capped in ``pyproject.toml`` for the same reason. :data:`INHERITED` lists the protected members that
our subclasses override or call.
"""

from __future__ import annotations

import operator
from collections import deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch as th
    from pettingzoo import ParallelEnv
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

INHERITED = {
    "stable_baselines3.DDPG": ("_setup_model", "_excluded_save_params", "_update_learning_rate", "_n_updates"),
    "stable_baselines3.common.buffers.ReplayBuffer": ("_get_samples",),
    "stable_baselines3.td3.policies.TD3Policy": ("_get_constructor_parameters", "_update_features_extractor"),
    "stable_baselines3.sac.policies.SACPolicy": ("_get_constructor_parameters", "_update_features_extractor"),
    "stable_baselines3.common.vec_env.VecEnv": ("_get_indices",),
}
"""Protected members that our subclasses override or call, by class."""

EPISODE_STATE = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""The current episodes in an SB3 model, as large as the networks in a file; a loaded model resets its env before it learns."""

_COUNTERS = ("_episode_num", "_n_updates", "_current_progress_remaining")


def optimizers_of(model: BaseAlgorithm) -> list[th.optim.Optimizer]:
    """The optimizers that SB3 saves with a model."""
    names = model._get_torch_save_params()[0]
    return [operator.attrgetter(name)(model) for name in names if name.endswith("optimizer")]


def n_updates(model: BaseAlgorithm) -> int:
    """Number of updates so far."""
    return int(model._n_updates)


def progress_remaining(model: BaseAlgorithm) -> float:
    """Remaining share of the training, from 1 to 0, as SB3's schedules get it."""
    return model._current_progress_remaining


def set_noise_std(noise: NormalActionNoise, std: float) -> None:
    """Change the standard deviation of Gaussian action noise."""
    noise._sigma = np.full_like(noise._sigma, std)


def counters(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """SB3's counters that a resumed training restores."""
    return {name: getattr(model, name) for name in _COUNTERS}


def set_counters(model: OffPolicyAlgorithm, values: Mapping[str, Any]) -> None:
    """Restore :func:`counters`."""
    for name in _COUNTERS:
        setattr(model, name, values[name])


def last_observations(model: BaseAlgorithm) -> Any:
    """The observations from which the next actions are computed, ``(slots, *shape)``."""
    return model._last_obs


def begin_at(model: OffPolicyAlgorithm, observations: Any, episodes: Iterable[Any]) -> None:
    """Let a model continue the current episodes.

    :param observations: their last observations, ``(slots, *shape)``
    :param episodes: statistics of the last finished episodes
    """
    model._last_obs = observations
    model._last_episode_starts = np.zeros(model.n_envs, dtype=bool)
    model.ep_info_buffer = deque(episodes, maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)  # this task's infos hold no successes


def copies_in_process(venv: Any) -> list[ParallelEnv]:
    """The copies of the env in a SuperSuit vector env without workers."""
    return [vec_env.par_env for vec_env in venv.vec_envs]


def is_multiprocess(venv: Any) -> bool:
    """Whether a SuperSuit vector env has workers."""
    from supersuit.vector.multiproc_vec import ProcConcatVec

    return isinstance(venv, ProcConcatVec)


def reset_workers(venv: Any, seeds: Iterable[int | None], options: Any, num_envs: int) -> tuple[Any, list[dict[str, Any]]]:
    """Reset the copies in SuperSuit's workers with given seeds; SuperSuit itself would let the seeds overlap.

    :param seeds: the first seed of each worker
    """
    from supersuit.vector.multiproc_vec import numpy_deepcopy

    for pipe, seed in zip(venv.pipes, seeds, strict=False):
        pipe.send(("reset", (seed, options)))
    infos: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    for start, compressed in zip(venv.idx_starts, venv._receive_info(), strict=False):
        for slot, info in compressed:
            infos[start + slot] = info
    return numpy_deepcopy(venv.observations_buffers), infos


def find_ray_cluster(address: str) -> str:
    """Host and port of a running Ray cluster.

    :raises ConnectionError: if there is none
    """
    from ray._private.services import canonicalize_bootstrap_address

    return str(canonicalize_bootstrap_address(address) or "")


def ray_trials(results: Any) -> list[Any]:
    """The trials behind Ray Tune's results."""
    return list(results._experiment_analysis.trials)
