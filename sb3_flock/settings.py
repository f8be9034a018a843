"""Settings: the base of every frozen, validated, self-describing group of parameters.

A field's ``description`` (with its unit and source) is the only documentation of that parameter: the command line's
``--help`` and the comments of every YAML file are made from it.
"""

from __future__ import annotations

import difflib
import numbers
import reprlib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

_Settings = TypeVar("_Settings", bound="Settings")

Positive = Annotated[float, Field(ge=1e-6, le=1e6)]
"""Lengths, speeds, weights: so far from the ends of the floating point numbers that no formula here overflows."""
NotNegative = Annotated[float, Field(ge=0, le=1e6)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


class UserError(ValueError):
    """Something that the user can mend; the message is one line that says what, whatever a file or a flag put into it."""

    def __init__(self, message: str) -> None:
        super().__init__("".join(letter if letter.isprintable() else "?" for letter in message[:_LONGEST_MESSAGE]))


_LONGEST_MESSAGE = 2000


class RunError(RuntimeError):
    """Something outside of the parameters went wrong in a run: a full disk, a dead worker, a diverged training."""


class SettingsError(UserError):
    """A parameter has a value that is not accepted."""


class Settings(BaseModel):
    """Frozen, validated parameters that refuse unknown names.

    :raises SettingsError: one line per wrong parameter, naming it, its value and what is accepted
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise SettingsError("; ".join(_describe(type(self), e) for e in error.errors())) from None

    def replace(self: _Settings, **changes: Any) -> _Settings:
        """A validated copy with some fields changed.

        :raises SettingsError: for an unknown name or a value that is not accepted
        """
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})


def check_integer(name: str, value: Any, least: int) -> None:
    """Whether an argument is an integer of at least ``least``.

    :raises SettingsError: if not
    """
    if not isinstance(value, numbers.Integral) or value < least:
        raise SettingsError(f"{name} = {shown(value)}: input should be an integer of at least {least}")


def group_of(annotation: Any) -> type[Settings] | None:
    """The settings class that a field holds, or ``None`` for a parameter."""
    is_class = isinstance(annotation, type) and get_origin(annotation) is None  # Python 3.10 takes tuple[int] for a class
    return annotation if is_class and issubclass(annotation, Settings) else None


def leaf_paths(settings: type[Settings], prefix: tuple[str, ...] = ()) -> Iterable[tuple[str, ...]]:
    """Every parameter of a settings class as a path of names, groups opened."""
    for name, field in settings.model_fields.items():
        group = group_of(field.annotation)
        if group is None:
            yield (*prefix, name)
        else:
            yield from leaf_paths(group, (*prefix, name))


def field_of(settings: Any, path: str) -> FieldInfo:
    """The field of a settings class that a whole path names, such as ``scenario.n_vehicles``."""
    *groups, name = path.split(".")
    for group in groups:
        settings = settings.model_fields[group].annotation
    field: FieldInfo = settings.model_fields[name]
    return field


def resolve_path(settings: type[Settings], key: str) -> tuple[str, ...]:
    """The parameter that ``key`` names; leading groups may be left out where no other parameter ends the same way.

    >>> resolve_path(TrainingConfig, "reward.lambda_")  # doctest: +SKIP
    ('scenario', 'reward', 'lambda_')

    :raises SettingsError: for an unknown or ambiguous key
    """
    wanted = tuple(key.split("."))
    paths = list(leaf_paths(settings))
    if wanted in paths:
        return wanted
    hits = [path for path in paths if path[-len(wanted) :] == wanted]
    if len(hits) == 1:
        return hits[0]
    if hits:
        raise SettingsError(f"{key} is ambiguous: {', '.join('.'.join(path) for path in hits)}")
    raise SettingsError(f"{key} is not a parameter{nearest(key, ['.'.join(path) for path in paths])}")


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint ``; did you mean ...?`` for a mistyped name, or an empty string."""
    by_tail = {candidate.split(".")[-1]: candidate for candidate in known}
    by_tail.update({candidate: candidate for candidate in by_tail.values()})
    tail = name.rsplit(".", maxsplit=1)[-1]
    close = difflib.get_close_matches(name, by_tail, n=1) or difflib.get_close_matches(tail, by_tail, n=1)
    return f"; did you mean {by_tail[close[0]]}?" if close else ""


def _describe(settings: type[Settings], error: Mapping[str, Any]) -> str:
    """One of pydantic's errors as ``parameter = value: what is accepted``."""
    path = ".".join(str(part) for part in error["loc"]) or settings.__name__
    if error["type"] == "extra_forbidden":
        return f"{path} is not a parameter of {settings.__name__}{nearest(path, settings.model_fields)}"
    if error["type"] == "value_error":  # raised by a validator of ours, which names the parameter itself
        return str(error["ctx"]["error"])
    message = error["msg"][0].lower() + error["msg"][1:]
    return f"{path} = {shown(error['input'])}: {message}"


def shown(value: Any) -> str:
    """A value as a message shows it: short, even if it is a YAML file's million laughs."""
    return _short.repr(value)


_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 200
