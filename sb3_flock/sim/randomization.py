"""Domain randomization: fields of the sensors and the actuators that have another value in each flock and episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flock.settings import Settings, SettingsError, format_value, suggest

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

Ranges = Mapping[str, Sequence[float]]
"""The lowest and the highest value of each randomized field, by the field's name with its group, such as
``actuators.speed_lag``."""

UNBOUNDED = 1e300
"""Stands for a bound that is ``None``: no product of it with a length or a time of the package overflows."""


class FlockValues:
    """The numbers of a group of settings, each as an array that broadcasts with one number a flock and vehicle.

    :param settings: the group; ``None`` is :data:`UNBOUNDED`
    :param drawn: values of some fields by name, one a flock, ``(flocks,)``

    :ivar are_drawn: whether the values of any field are
    """

    def __init__(self, settings: Settings, drawn: Mapping[str, NDArray[np.float64]] | None = None) -> None:
        fixed = {name: getattr(settings, name) for name in type(settings).model_fields}
        self._values = {
            name: np.full((1, 1), UNBOUNDED if value is None else value, dtype=np.float64) for name, value in fixed.items()
        }
        self._values.update({name: np.asarray(values, np.float64)[:, None] for name, values in (drawn or {}).items()})
        default = type(settings)()
        self._active = set(drawn or ()) | {name for name, value in fixed.items() if value != getattr(default, name)}
        self.are_drawn = bool(drawn)

    def __getattr__(self, name: str) -> NDArray[np.float64]:
        """The values of a field, ``(flocks, 1)`` or ``(1, 1)``."""
        if name.startswith("_") or name not in self._values:
            raise AttributeError(name)
        return self._values[name]

    def is_on(self, name: str) -> bool:
        """Whether a field is drawn or differs from its default; no flock's values decide for another."""
        return name in self._active

    def of_flocks(self, name: str, n_flocks: int) -> NDArray[np.float64]:
        """The values of a field, one a flock, ``(flocks,)``."""
        return np.ascontiguousarray(np.broadcast_to(self._values[name][:, 0], (n_flocks,)))


def check_ranges(ranges: Ranges, groups: Mapping[str, Settings]) -> None:
    """Check that every range is of a field that can be randomized, and within the field's own bounds.

    :param groups: the groups of fields that can be randomized, by name
    :raises SettingsError: one line for the first that is not
    """
    known = [f"{name}.{field}" for name, group in groups.items() for field in type(group).model_fields]
    for name, limits in ranges.items():
        shown = f"randomization.{name} = {format_value(list(limits))}"
        if name not in known:
            raise SettingsError(f"{shown}: the name of a field of {' or '.join(groups)} is needed{suggest(name, known)}")
        if len(limits) != 2 or limits[0] > limits[1]:
            raise SettingsError(f"{shown}: input should be the lowest and the highest value")
        group, _, field = name.partition(".")
        for value in limits:
            try:
                groups[group].replace(**{field: value})
            except SettingsError as error:
                raise SettingsError(f"{shown}: {str(error).partition(': ')[2]}") from None


def draw(ranges: Ranges, rngs: Sequence[Generator]) -> dict[str, NDArray[np.float64]]:
    """A value of each randomized field for each flock, ``(flocks,)``, uniform in its range, by the flock's own generator."""
    names = sorted(ranges)
    values = np.array([[rng.uniform(ranges[name][0], ranges[name][1]) for name in names] for rng in rngs])
    return {name: values[:, number].copy() for number, name in enumerate(names)}


def own_rngs(rngs: Sequence[Generator]) -> list[Generator]:
    """A generator for a part of each flock, seeded by a draw from the flock's own: the part's draws change no other's."""
    return [np.random.default_rng(rng.integers(2**63, size=2)) for rng in rngs]


def rng_states(rngs: Sequence[Generator]) -> list[Any]:
    """The states of generators, as plain values."""
    return [rng.bit_generator.state for rng in rngs]


def rngs_of(states: Sequence[Any]) -> list[Generator]:
    """The generators of :func:`rng_states`."""
    rngs = [np.random.default_rng() for _ in states]
    for rng, state in zip(rngs, states, strict=True):
        rng.bit_generator.state = state
    return rngs
