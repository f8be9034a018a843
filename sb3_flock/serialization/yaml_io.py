"""Reading and writing configs: YAML with a comment on every key, and ``key=value`` overrides.

A file may hold any part of a config: fields that it leaves out keep their defaults.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sb3_flock._renamed import RenamedWarning
from sb3_flock.serialization.archive import read_text
from sb3_flock.serialization.migrate import FORMAT, format_of, migrate_config
from sb3_flock.settings import Settings, SettingsError, format_value, group_of, leaf_paths, resolve_path, suggest

_Settings = TypeVar("_Settings", bound=Settings)


class _Loader(yaml.SafeLoader):
    """YAML's safe loader with the scalars of YAML 1.2, and without keys that occur twice.

    PyYAML reads YAML 1.1, in which ``yes`` and ``off`` are booleans, ``1:30`` is 90, ``010`` is 8, ``1e-3`` is text and
    ``2024-01-01`` is a date. Here they are text, text, 10, a number and text.
    """

    yaml_implicit_resolvers = {}  # noqa: RUF012 - instead of those of YAML 1.1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping of a node.

        :raises SettingsError: for a key that occurs twice
        """
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                if key.value in seen:
                    raise SettingsError(f"{format_value(key.value)} is given twice, again in line {key.start_mark.line + 1}")
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> float | int:
        """An integer, also one that is written as ``1e5``, or a float."""
        text = node.value.replace("_", "").lower()
        value = float(text.replace(".inf", "inf").replace(".nan", "nan"))
        whole = re.fullmatch(r"[-+]?[0-9]+(e\+?[0-9]+)?", text) and math.isfinite(value)
        return (int(text) if "e" not in text else int(value)) if whole else value


_MERGE = "tag:yaml.org,2002:merge"
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9][0-9_]*", list("-+0123456789")),
    (
        "float",
        r"[-+]?([0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("merge", r"<<", ["<"]),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first)
for _tag in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _Loader.construct_number)


def load_config(
    settings: type[_Settings],
    path: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    base: _Settings | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> _Settings:
    """A config from a YAML file, from another config or from the defaults, with overrides applied.

    :param path: YAML file; keys it leaves out keep their defaults
    :param base: the config to start from, instead of a file
    :param overrides: values by parameter name, leading groups may be left out (``reward.lambda_``)
    :param defaults: values by parameter name for the keys that the file leaves out
    :raises SettingsError: one line for a file or a value that is not accepted
    """
    values: dict[str, Any] = {} if base is None else base.model_dump()
    if path is not None:
        values = _migrated(settings, read_yaml(Path(path)), Path(path))
    check_groups(settings, values)
    for key, value in (defaults or {}).items():
        level, name = _place_of(settings, key, values)
        level.setdefault(name, value)
    for key, value in (overrides or {}).items():
        level, name = _place_of(settings, key, values)
        level[name] = value
    return settings(**values)


def _place_of(settings: type[Settings], key: str, values: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """The group in a config's values that holds a parameter, made if it is missing, and the parameter's own name."""
    *groups, name = resolve_path(settings, key)
    for group in groups:
        values = values.setdefault(group, {})
    return values, name


def parse_overrides(assignments: Iterable[str]) -> dict[str, Any]:
    """``["reward.lambda_=0.5", ...]`` as a mapping; values are read as YAML.

    :raises SettingsError: for an assignment without ``=`` or a value that is not YAML
    """
    overrides = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise SettingsError(f"{assignment}: KEY=VALUE is needed, such as reward.lambda_=0.5")
        try:
            overrides[key] = yaml.load(text, _Loader)
        except SettingsError as error:
            raise SettingsError(f"{assignment}: {error}") from None
        except (yaml.YAMLError, ValueError):
            raise SettingsError(f"{assignment}: the value is not YAML") from None
    return overrides


def to_yaml(config: Settings) -> str:
    """The whole config as YAML with its format number, every key commented with its description."""
    return "\n".join([f"format: {FORMAT} # of this file", *_lines(config, indent="")]) + "\n"


def _lines(config: Settings, indent: str) -> Iterable[str]:
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Settings):
            yield f"{indent}{name}: # {field.description}"
            yield from _lines(value, indent + "  ")
        else:
            plain = config.model_dump(mode="json", include={name})[name]
            text = yaml.safe_dump(plain, default_flow_style=True, sort_keys=False, width=10**9)
            yield f"{indent}{name}: {text.removesuffix('...' + chr(10)).strip()} # {field.description}"


def read_yaml(path: Path, text: str | None = None) -> dict[str, Any]:
    """A YAML file's mapping; an empty file's is empty.

    :param text: the file's text, if it was read already
    :raises SettingsError: one line for a file that cannot be read or holds no mapping
    """
    try:
        values = yaml.load(read_text(path) if text is None else text, _Loader)
    except OSError as error:
        raise SettingsError(f"config {path}: {error.strerror or error}") from None
    except SettingsError as error:
        raise SettingsError(f"config {path}: {error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SettingsError(f"config {path}: not a YAML file ({' '.join(str(error).split())})") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SettingsError(f"config {path}: a mapping of parameters is needed")
    return values


class EarlierFormatWarning(RenamedWarning):
    """A file has names of an earlier release.

    :param path: the file
    :param renamed: (old, new) names
    """

    def __init__(self, path: Path, renamed: Sequence[tuple[str, str]]) -> None:
        self.path = path
        shown = [f"{old} is now {new}" for old, new in renamed[: _MOST_SHOWN if len(renamed) > _MAX_SHOWN else None]]
        more = f", and {len(renamed) - len(shown)} more" if len(shown) < len(renamed) else ""
        super().__init__(f"{path}: written by an earlier release ({', '.join(shown)}{more})")


_MAX_SHOWN = 4
_MOST_SHOWN = 2
"""Renamed names in a warning: all up to the first number, else as many as the second."""


def _migrated(settings: type[Settings], values: dict[str, Any], path: Path) -> dict[str, Any]:
    """A file's values in the present format; one warning names old names in it."""
    number = format_of(settings, values)
    values.pop("format", None)
    current, renamed = migrate_config(settings, values, number)
    if renamed:
        warnings.warn(EarlierFormatWarning(path, renamed), stacklevel=3)
    return current


def check_groups(settings: type[Settings], values: Mapping[str, Any], prefix: str = "") -> None:
    """Check names and groups of a config's values, with the whole path in the message.

    :raises SettingsError: for an unknown name, or a scalar where a group belongs
    """
    _check_groups(settings, settings, values, prefix)


def _check_groups(whole: type[Settings], settings: type[Settings], values: Mapping[str, Any], prefix: str) -> None:
    for name, value in values.items():
        field = settings.model_fields.get(name) if isinstance(name, str) else None
        if field is None:
            near = [prefix + ".".join(path) for path in leaf_paths(settings)]
            hint = suggest(str(name), near) or suggest(str(name), [".".join(path) for path in leaf_paths(whole)])
            raise SettingsError(f"{prefix}{name} is not a parameter{hint}{_place(hint, prefix)}")
        group = group_of(field.annotation)
        if group is not None:
            if not isinstance(value, Mapping):
                raise SettingsError(f"{prefix}{name} = {format_value(value)}: a mapping of parameters is needed")
            _check_groups(whole, group, value, f"{prefix}{name}.")


def _place(hint: str, prefix: str) -> str:
    """Where a suggested field belongs in a file, if in another group: a key with dots is not read as groups there."""
    group, _, name = hint.removeprefix("; did you mean ").removesuffix("?").rpartition(".")
    return f" That is {name} in the group {group}" if hint and group and f"{group}." != prefix else ""
