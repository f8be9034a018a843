"""Settings: the base class of every frozen, validated, self-describing group of parameters, and the errors of the package.

A field's ``description`` (with its unit and the paper's value) is the only documentation of that parameter: the command
line's ``--help`` and the comments of every YAML file are made from it.
"""

from __future__ import annotations

import difflib
import inspect
import numbers
import reprlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from sb3_flock._renamed import rename_fields, rename_key, warn_renamed
from sb3_flock.errors import ActionError, RunError, SettingsError, UserError

__all__ = [
    "ActionError",
    "Coordinate",
    "NotNegative",
    "Positive",
    "RunError",
    "Settings",
    "SettingsError",
    "UserError",
    "check_integer",
    "field_of",
    "format_value",
    "group_of",
    "leaf_paths",
    "resolve_path",
    "suggest",
]

_Settings = TypeVar("_Settings", bound="Settings")

Positive = Annotated[float, Field(ge=1e-6, le=1e6)]
"""Lengths, speeds, weights: bounded so that no formula of the package overflows."""
NotNegative = Annotated[float, Field(ge=0, le=1e6)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


if TYPE_CHECKING:
    from typing_extensions import Self

    class _Model:
        """Pydantic's base class for type checkers.

        They would take a parameter with a positional default in ``Field`` for a required one, and refuse a dict for a group.
        """

        model_config: ClassVar[ConfigDict]
        model_fields: ClassVar[dict[str, FieldInfo]]

        def __init__(self, **values: Any) -> None: ...
        @property
        def model_fields_set(self) -> set[str]: ...
        def model_copy(self, **options: Any) -> Self: ...
        def model_dump(self, **options: Any) -> dict[str, Any]: ...
        def model_dump_json(self, **options: Any) -> str: ...
        @classmethod
        def model_json_schema(cls, **options: Any) -> dict[str, Any]: ...
        @classmethod
        def model_validate(cls, obj: Any, **options: Any) -> Self: ...

else:
    _Model = BaseModel


class Settings(_Model):
    """Frozen, validated parameters that refuse unknown names.

    The docstring of a class lists its fields.

    :raises SettingsError: one line per wrong parameter, naming it, its value and what is accepted
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        values, renamed = rename_fields(type(self).__name__, values)
        for old, new in renamed:
            warn_renamed(f"{type(self).__name__}: {old}", new, stacklevel=2)
        for name, value in values.items():
            if isinstance(value, bool) and name in type(self).model_fields:
                _refuse_as_number(name, value, type(self).model_fields[name].annotation)
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise SettingsError(*(_describe(type(self), e) for e in error.errors())) from None

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Add the fields to the docstring, for ``help()``."""
        fields = "\n".join(f":param {name}: {field.description}" for name, field in cls.model_fields.items())
        cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\n{fields}"

    def replace(self: _Settings, **changes: Any) -> _Settings:
        """A validated copy with some fields changed.

        :raises SettingsError: for an unknown name or a value that is not accepted
        """
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})


def _refuse_as_number(name: str, value: bool, annotation: Any) -> None:
    """Pydantic takes ``True`` for 1.

    :raises SettingsError: if the field takes numbers and no booleans
    """
    kinds = get_args(annotation) or (annotation,)
    if bool not in kinds and any(kind in (int, float) for kind in kinds):
        raise SettingsError(f"{name} = {value}: input should be a number")


def check_integer(name: str, value: Any, least: int) -> None:
    """Check that an argument is an integer of at least ``least``.

    :raises SettingsError: if it is not
    """
    if not isinstance(value, numbers.Integral) or value < least:
        raise SettingsError(f"{name} = {format_value(value)}: input should be an integer of at least {least}")


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
    if not hits and rename_key(key) != key:
        found = resolve_path(settings, rename_key(key))
        warn_renamed(key, ".".join(found), stacklevel=2)
        return found
    if hits:
        raise SettingsError(f"{key} is ambiguous: {', '.join('.'.join(path) for path in hits)}")
    raise SettingsError(f"{key} is not a parameter{suggest(key, ['.'.join(path) for path in paths])}")


_ALIASES = {"lr": "learning_rate", "timesteps": "total_timesteps", "n_envs": "n_flocks", "n_agents": "n_vehicles"}
"""What other libraries call our parameters."""


def first_line(error: Exception) -> str:
    """An error's first line, shortened."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def suggest(name: str, known: Iterable[str]) -> str:
    """A hint ``; did you mean ...?`` for a mistyped name, or an empty string."""
    by_tail = {candidate.split(".")[-1]: candidate for candidate in known}
    name = _ALIASES.get(name, name)
    by_tail.update({candidate: candidate for candidate in by_tail.values()})
    tail = name.rsplit(".", maxsplit=1)[-1]
    close = difflib.get_close_matches(name, by_tail, n=1) or difflib.get_close_matches(tail, by_tail, n=1)
    return f"; did you mean {by_tail[close[0]]}?" if close else ""


def _describe(settings: type[Settings], error: Mapping[str, Any]) -> str:
    """One of pydantic's errors as ``parameter = value: what is accepted``."""
    path = ".".join(str(part) for part in error["loc"]) or settings.__name__
    if error["type"] == "extra_forbidden":
        return f"{path} is not a parameter of {settings.__name__}{suggest(path, settings.model_fields)}"
    if error["type"] == "value_error":  # raised by a validator of ours, which names the parameter itself
        reason = error["ctx"]["error"]
        field = settings.model_fields.get(str(error["loc"][0])) if error["loc"] else None
        if field is None or group_of(field.annotation) is None:
            return str(reason)
        return "; ".join(f"{path}.{part}" for part in getattr(reason, "parts", (str(reason),)))
    message = error["msg"][0].lower() + error["msg"][1:]
    return f"{path} = {format_value(error['input'])}: {message}"


def format_value(value: Any) -> str:
    """A value as an error message shows it: shortened, even if a YAML file expands it to millions of entries."""
    return _short.repr(value)


_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 200
