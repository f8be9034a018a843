"""The SuperSuit flattening of a PettingZoo env into one SB3 vector env with shared parameters, with its defects fixed.

Every agent of every copy becomes one slot of the vector env, copy by copy: slot ``copy * n_agents + i`` is the copy's agent
``possible_agents[i]``, and its action goes to that agent alone. One policy serves all slots: that is parameter sharing.

This package's own flocks are copies within one env, which simulates them in one batch: stepping 32 envs of one flock each takes
several times as long.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any

import numpy as np
import supersuit
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from supersuit.vector.concat_vec_env import ConcatVecEnv
from supersuit.vector.multiproc_vec import ProcConcatVec
from supersuit.vector.sb3_vector_wrapper import SB3VecEnvWrapper

from sb3_flock._compat import copies_in_process, is_multiprocess, reset_workers
from sb3_flock.envs import flocking_v0
from sb3_flock.envs.flat_env import RESET_INFO, FlatEnv
from sb3_flock.envs.multi_flock import MultiFlockEnv
from sb3_flock.envs.wrappers import check_parallel_env, layers_of, owner_of, without_black_death
from sb3_flock.settings import RunError, SettingsError, check_integer
from sb3_flock.sim import Scenario, check_actions

if TYPE_CHECKING:
    from sb3_flock.sim.randomization import Ranges


def make_vec_env(
    scenario: Scenario | None = None,
    n_flocks: int = 8,
    num_cpus: int = 0,
    seed: int | None = None,
    render_mode: str | None = None,
    monitor: bool = False,
    randomization: Ranges | None = None,
) -> ParameterSharingVecEnv:
    """Flocks of one scenario as an SB3 vector env with ``n_flocks * n_vehicles`` slots.

    :param scenario: the task; the default is the paper's experiment 1
    :param n_flocks: number of independent flocks
    :param num_cpus: worker processes; 0 keeps everything in this process, which is faster for this light env
    :param seed: seeds all flocks, each with a stream of its own, whatever ``num_cpus``
    :param render_mode: as in :class:`~sb3_flock.envs.flocking_v0.parallel_env`; the first flock is drawn
    :param monitor: as in :func:`flatten`
    :param randomization: ranges of randomized fields, as in :class:`~sb3_flock.envs.flocking_v0.parallel_env`
    :raises SettingsError: for a count or a range that is not accepted
    """
    check_integer("n_flocks", n_flocks, least=1)

    def make_env(count: int) -> flocking_v0.parallel_env:
        return flocking_v0.parallel_env(scenario, render_mode, count, randomization=randomization)

    return flatten_batch(make_env, n_flocks, num_cpus, seed, monitor)


def flatten_batch(
    make_env: Callable[[int], flocking_v0.parallel_env | MultiFlockEnv],
    n_copies: int,
    num_cpus: int = 0,
    seed: int | None = None,
    monitor: bool = False,
) -> ParameterSharingVecEnv:
    """Flocks of this package's envs flattened into one SB3 vector env; each process simulates its own in one batch.

    :param make_env: makes an env of a number of copies
    :param n_copies: number of independent copies
    :param num_cpus: worker processes; 0 and 1 keep everything in this process
    :param seed: seeds all copies, each with a stream of its own, whatever ``num_cpus``
    :param monitor: as in :func:`flatten`
    :raises SettingsError: for a count that is not accepted
    """
    check_integer("num_cpus", num_cpus, least=0)
    share = -(-n_copies // max(num_cpus, 1))
    if share == n_copies:
        return flatten(make_env(n_copies), seed=seed, monitor=monitor)
    example = FlatEnv(make_env(1))
    workers = [
        partial(_flat, make_env, min(share, n_copies - first)) for first in range(0, n_copies, share)
    ]  # the last one may have fewer copies, which SuperSuit's own constructor does not provide for
    slots = n_copies * example.num_envs
    vec_env = ProcConcatVec(workers, example.observation_space, example.action_space, slots, example.metadata)
    adapter = ParameterSharingVecEnv(vec_env, example.par_env, monitor)
    adapter.seed(seed)
    return adapter


def _flat(make_env: Callable[[int], ParallelEnv], n_copies: int) -> FlatEnv:
    return FlatEnv(make_env(n_copies))


def flatten(
    env: ParallelEnv, n_copies: int = 1, num_cpus: int = 0, seed: int | None = None, monitor: bool = False
) -> ParameterSharingVecEnv:
    """Any PettingZoo parallel env whose agents share their spaces, copied and flattened into one SB3 vector env.

    Agents may die or join in any step; :class:`~sb3_flock.envs.flat_env.FlatEnv` says what their slots then show.

    :param env: the env; SuperSuit's ``black_death_v3`` around it is not needed, and has no effect
    :param n_copies: number of independent copies
    :param num_cpus: worker processes; 0 and 1 keep everything in this process
    :param seed: seeds all copies, each with a stream of its own
    :param monitor: put each agent's return, length and time into the info of its last step, under ``episode``, as SB3's
        ``Monitor`` does; unlike ``VecMonitor`` it does not count the steps in which a slot has no agent
    :raises SettingsError: for a count that is not accepted, something else than a parallel env, or agents that differ in a
        space
    """
    check_integer("n_copies", n_copies, least=1)
    check_integer("num_cpus", num_cpus, least=0)
    check_parallel_env(env)
    if n_copies > 1 and getattr(env.unwrapped, "n_copies", 1) > 1:
        raise SettingsError(f"n_copies = {n_copies}: 1 is needed for an env that holds several copies itself")
    env = without_black_death(env)
    vec_env = supersuit.concat_vec_envs_v1(FlatEnv(env), n_copies, num_cpus=num_cpus, base_class="gymnasium")
    adapter = ParameterSharingVecEnv(vec_env, env, monitor)
    adapter.seed(seed)
    return adapter


class ParameterSharingVecEnv(SB3VecEnvWrapper):
    """SuperSuit's SB3 wrapper with its defects fixed; use :func:`make_vec_env` or :func:`flatten` to build one.

    What it adds: seeds that reproduce and that differ between copies, with and without workers; ``TimeLimit.truncated``
    wherever an episode is cut and not ended; boolean ``dones``; agents that die or join; ``reset_infos``, also of automatic
    resets; SB3's ``get_attr``, ``set_attr`` and ``env_method`` (without workers); ``render_mode`` through wrappers and
    workers; one clear error when a worker dies, and workers that close.

    Where one env simulates several copies in a batch, ``get_attr`` and ``env_method`` show each copy alone
    (:meth:`~sb3_flock.envs.flocking_v0.parallel_env.copy_at`); what they change in it has no effect on the batch.

    :ivar n_agents: agents of one copy; slot ``s`` is agent ``s % n_agents`` of copy ``s // n_agents``
    """

    def __init__(self, venv: ConcatVecEnv | ProcConcatVec, example: ParallelEnv, monitor: bool = False) -> None:
        self._copies_per_env = getattr(example.unwrapped, "n_copies", 1)
        self.n_agents = len(example.possible_agents) // self._copies_per_env
        if is_multiprocess(venv):
            venv.render_mode = getattr(example.unwrapped, "render_mode", None)
        super().__init__(venv)
        self.metadata = venv.metadata
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._has_workers = is_multiprocess(venv)
        self._seed: int | None = None
        self._unseeded = True
        self._options: dict[str, Any] | None = None
        self._closed = False
        self._monitors, self._started = monitor, time.monotonic()
        self._returns, self._lengths = np.zeros(self.num_envs), np.zeros(self.num_envs, int)

    # -- seeding -----------------------------------------------------------------------------------------------------

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Store a seed for the next reset, as SB3's own vector envs do; ``None`` means fresh entropy at the first one.

        :raises SettingsError: for a negative seed
        """
        if seed is not None:
            check_integer("seed", seed, least=0)
        self._seed = seed
        return [seed] * self.num_envs

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> NDArray[Any]:
        """Reset every copy; one that was seeded since the last reset starts its random stream anew.

        :return: observations, ``(slots, *observation shape)``
        """
        if seed is not None:
            self.seed(seed)
        if self._seed is None and not self._unseeded:
            first = None  # every copy's own stream continues
        else:
            # SuperSuit hands copy i the seed `first + i`; hashing keeps the copies of neighboring seeds apart.
            first = int(np.random.SeedSequence(self._seed).generate_state(1)[0]) // 2
        self._seed, self._unseeded = None, False
        options, self._options = (self._options if options is None else options), None
        reset = self._reset_workers if self._has_workers else self.venv.reset
        with self._guarded():
            observations, self.reset_infos = reset(seed=first, options=options)
        self._returns[:], self._lengths[:] = 0, 0
        return observations

    def _reset_workers(self, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, list[dict[str, Any]]]:
        """Seed the workers' copies as if they were in this process."""
        seeds = (None if seed is None else seed + start // self.n_agents for start in self.venv.idx_starts)
        return reset_workers(self.venv, seeds, options, self.num_envs)

    # -- stepping ----------------------------------------------------------------------------------------------------

    def step_async(self, actions: NDArray[Any]) -> None:
        """Send one action to each slot.

        :raises ActionError: for actions of another shape, or that are not finite
        """
        if isinstance(self.action_space, spaces.Box):
            check_actions(np.asarray(actions), (self.num_envs, *self.action_space.shape), "slot")
        with self._guarded():
            self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Collect the step: ``(observations, rewards, dones, infos)`` as SB3 expects them."""
        with self._guarded():
            observations, rewards, terminations, truncations, infos = self.venv.step_wait()
        terminations, truncations = np.asarray(terminations, dtype=bool), np.asarray(truncations, dtype=bool)
        dones = terminations | truncations
        for slot, info in enumerate(infos):
            if RESET_INFO in info:
                self.reset_infos[slot] = info.pop(RESET_INFO)
        ends = np.flatnonzero(dones).tolist()
        for slot in ends:
            infos[slot]["TimeLimit.truncated"] = bool(truncations[slot] and not terminations[slot])
        if self._monitors:
            self._returns += rewards
            self._lengths += [info["alive"] for info in infos]
            seconds = round(time.monotonic() - self._started, 6)
            for slot in ends:
                infos[slot]["episode"] = {"r": float(self._returns[slot]), "l": int(self._lengths[slot]), "t": seconds}
            self._returns[ends], self._lengths[ends] = 0, 0
        return observations, rewards, dones, infos

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn the broken pipe of a dead worker into one clear error and close the rest."""
        try:
            yield
        except (EOFError, OSError) as error:
            if not self._has_workers:
                raise  # an error of the env itself
            ending = wait([proc.sentinel for proc in self.venv.procs], timeout=5)
            for proc in self.venv.procs:
                if proc.sentinel in ending:
                    proc.join(5)  # its pipes close a moment before it is gone
            dead = [f"{proc.pid} (exit code {proc.exitcode})" for proc in self.venv.procs if not proc.is_alive()]
            self.close()
            who = ", ".join(dead) or "unknown"
            raise RunError(f"an environment worker died: process {who}; the rest was closed") from error

    def close(self) -> None:
        """Close every copy, in the workers too, and end the workers."""
        if self._closed:
            return
        self._closed = True
        if not self._has_workers:
            self.venv.close()
            return
        for pipe, proc in zip(self.venv.pipes, self.venv.procs, strict=True):
            try:
                pipe.send("close")
                pipe.recv()
                pipe.send("terminate")
            except (EOFError, OSError):
                proc.kill()  # it is dead, or does not answer
            proc.join(self.venv.graceful_shutdown_timeout)
        self.venv.close()

    # -- state --------------------------------------------------------------------------------------------------------

    def state_dict(self) -> list[dict[str, Any]] | None:
        """The current episodes and the random streams of every env, or ``None`` where workers hold them.

        :raises NotImplementedError: for an env without ``state_dict``
        """
        if self._has_workers:
            return None
        monitored = [{"returns": self._returns.copy(), "lengths": self._lengths.copy()}] if self._monitors else []
        return [_with_state(env).state_dict() for env in copies_in_process(self.venv)] + monitored

    def load_state_dict(self, state: Sequence[Mapping[str, Any]]) -> None:
        """Restore the episodes of :meth:`state_dict`; the next reset continues their random streams."""
        if self._monitors:
            *state, monitored = state
            self._returns[:], self._lengths[:] = monitored["returns"], monitored["lengths"]
        for env, saved in zip(copies_in_process(self.venv), state, strict=True):
            _with_state(env).load_state_dict(saved)
        self._seed, self._unseeded = None, False

    # -- SB3's access to the copies ----------------------------------------------------------------------------------

    def set_options(self, options: dict[str, Any] | None = None) -> None:
        """Options for every copy's next reset."""
        self._options = options

    def has_attr(self, attr_name: str) -> bool:
        """Whether the copies have an attribute."""
        return attr_name == "render_mode" or all(owner is not None for owner in self._owners(attr_name, None))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of each slot's copy, of the outermost wrapper that has it; ``render_mode`` also with workers.

        :raises AttributeError: if a copy does not have it
        """
        if attr_name == "render_mode":
            return [self.render_mode for _ in self._get_indices(indices)]
        return [getattr(owner, attr_name) for owner in self._owners(attr_name, indices, needed=True)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute where :meth:`get_attr` finds it in each slot's copy, or of its outermost wrapper.

        Copies that one env simulates in a batch share theirs.

        :raises NotImplementedError: for some of the slots, where the copies are simulated in a batch
        """
        envs = self._envs()
        slots = list(self._get_indices(indices))
        if self._copies_per_env > 1 and len(slots) < self.num_envs:
            raise NotImplementedError(f"set_attr({attr_name!r}): the copies share their attributes; leave out indices")
        for number in {slot // self.n_agents // self._copies_per_env for slot in slots}:
            setattr(owner_of(envs[number], attr_name) or envs[number], attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method once a slot on the slot's copy, or on its outermost wrapper that has the method.

        :raises AttributeError: if a copy does not have it
        """
        owners = self._owners(method_name, indices, needed=True)
        return [getattr(owner, method_name)(*args, **kwargs) for owner in owners]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether each slot's copy has a PettingZoo wrapper of a class; true for SB3's ``Monitor`` with ``monitor=True``.

        False with workers, which give no access to their envs.
        """
        slots = list(self._get_indices(indices))
        if wrapper_class is Monitor or self._has_workers:
            return [self._monitors and wrapper_class is Monitor] * len(slots)
        found = [any(isinstance(layer, wrapper_class) for layer in layers_of(env)) for env in self._envs()]
        return [found[slot // self.n_agents // self._copies_per_env] for slot in slots]

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """One image per copy, or of the first copy alone with workers."""
        if self._has_workers:
            return [self.render()]
        return self.env_method("render", indices=range(0, self.num_envs, self.n_agents))

    def render(self, mode: str | None = None) -> NDArray[np.uint8] | None:
        """Draw the first copy in the render mode it was made with; ``mode`` exists for SB3's interface and must agree."""
        if mode is not None and mode != self.render_mode:
            warnings.warn(f"mode {mode!r} is ignored: the env was made with render_mode={self.render_mode!r}", stacklevel=2)
        with self._guarded():
            return self.venv.render()

    def getattr_recursive(self, name: str) -> Any:
        """Let SB3's wrappers around this one see its attributes."""
        return object.__getattribute__(self, name)  # not getattr: SB3 falls back to this method

    def _envs(self) -> list[ParallelEnv]:
        if self._has_workers:
            raise NotImplementedError("SuperSuit's workers give no access to their envs: use num_cpus=0")
        return copies_in_process(self.venv)

    def _owners(self, name: str, indices: Any, needed: bool = False) -> Iterator[Any]:
        """What has an attribute in each slot's copy: the copy or a wrapper around it, or ``None``.

        :param needed: take the copy instead of ``None``
        """
        envs = self._envs()
        owners: dict[int, Any] = {}
        for slot in self._get_indices(indices):
            number = slot // self.n_agents
            if number not in owners:
                env = envs[number // self._copies_per_env]
                owner = owner_of(env, name) or (env.unwrapped if needed else None)
                if self._copies_per_env > 1 and owner is env.unwrapped:
                    owner = owner.copy_at(number % self._copies_per_env)
                owners[number] = owner
            yield owners[number]


def _with_state(env: ParallelEnv) -> Any:
    owner = owner_of(env, "state_dict")
    if owner is None:
        raise NotImplementedError(
            f"{type(env.unwrapped).__name__} has no state_dict and load_state_dict to save its episodes"
        )
    return owner
