"""Reading and writing configs: YAML with a comment on every key, and ``key=value`` overrides."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sb3_flock.settings import Settings, SettingsError, group_of, nearest, resolve_path, shown

_Settings = TypeVar("_Settings", bound=Settings)


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, but 1e-3 is the number it looks like; YAML 1.1 would have it a string."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def load_config(
    settings: type[_Settings],
    path: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    base: _Settings | None = None,
) -> _Settings:
    """A config from a YAML file, from another config or from the defaults, with overrides applied.

    :param path: YAML file; keys it leaves out keep their defaults
    :param base: the config to start from, instead of a file
    :param overrides: values by parameter name, leading groups may be left out (``reward.lambda_``)
    :raises SettingsError: one line for a file or a value that is not accepted
    """
    values: dict[str, Any] = {} if base is None else base.model_dump()
    if path is not None:
        values = read_yaml(Path(path))
    _check_groups(settings, values, "")
    for key, value in (overrides or {}).items():
        *groups, name = resolve_path(settings, key)
        level = values
        for group in groups:
            level = level.setdefault(group, {})
        level[name] = value
    return settings(**values)


def parse_overrides(assignments: Iterable[str]) -> dict[str, Any]:
    """``["reward.lambda_=0.5", ...]`` as a mapping; values are read as YAML.

    :raises SettingsError: for an assignment without ``=`` or a value that is not YAML
    """
    overrides = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise SettingsError(f"--set {assignment}: KEY=VALUE is needed, such as reward.lambda_=0.5")
        try:
            overrides[key] = yaml.load(text, _Loader)
        except (yaml.YAMLError, ValueError):
            raise SettingsError(f"--set {assignment}: the value is not YAML") from None
    return overrides


def to_yaml(config: Settings) -> str:
    """The config as YAML, every key commented with its description."""
    return "\n".join(_lines(config, indent="")) + "\n"


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
        values = yaml.load(path.read_text(encoding="utf-8") if text is None else text, _Loader)
    except OSError as error:
        raise SettingsError(f"config {path}: {error.strerror or error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SettingsError(f"config {path}: not a YAML file ({' '.join(str(error).split())})") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SettingsError(f"config {path}: a mapping of parameters is needed")
    return values


def _check_groups(settings: type[Settings], values: Mapping[str, Any], prefix: str) -> None:
    """Refuse unknown names and scalars where a group belongs, with the whole path in the message."""
    for name, value in values.items():
        field = settings.model_fields.get(name) if isinstance(name, str) else None
        if field is None:
            hint = nearest(str(name), settings.model_fields)
            raise SettingsError(f"{prefix}{name} is not a parameter{hint}")
        group = group_of(field.annotation)
        if group is not None:
            if not isinstance(value, Mapping):
                raise SettingsError(f"{prefix}{name} = {shown(value)}: a mapping of parameters is needed")
            _check_groups(group, value, f"{prefix}{name}.")
