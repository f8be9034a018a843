"""Rewrites files of earlier formats in the present one: policies, model cards and configs. No code from a file is run."""

from __future__ import annotations

import io
import itertools
import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flock._compat import EPISODE_STATE
from sb3_flock._renamed import POLICIES, rename_key
from sb3_flock.config.training import TrainingConfig
from sb3_flock.envs.vec_env import make_vec_env
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.archive import check_clock, read_member, read_text
from sb3_flock.serialization.load import PolicyError, load_policy
from sb3_flock.serialization.migrate import FORMAT, MEMBER, format_of, migrate_card, migrate_config
from sb3_flock.serialization.save import atomic_write
from sb3_flock.serialization.yaml_io import check_groups, read_yaml, to_yaml
from sb3_flock.settings import SettingsError, UserError, first_line, leaf_paths

_CHECKPOINT = "training.json"
"""A member that only checkpoints have."""

_MAX_MEMBER = 2**28
_MAX_JSON = 2**20
_MAX_CARD = 2**22


def rewrite(path: str | Path) -> bool:
    """Rewrite a policy, a model card or a config in the present format, in place, whole or not at all.

    A policy keeps its weights to the last bit and the versions it was trained with. A config keeps the keys that it has; one
    that holds all groups is written with the comment of every key, another keeps its leading comments only.

    :param path: a zip, JSON or YAML file
    :return: whether the file changed; a file of the present format stays as it is
    :raises UserError: one line for a file that cannot be read or written, or is none of these
    """
    path = Path(path)
    try:
        if path.suffix == ".json":
            content = _card(path)
        elif path.suffix in (".yaml", ".yml"):
            content = _config(path)
        elif path.is_dir() or not zipfile.is_zipfile(path):
            path.open("rb").close()  # a missing file is reported as such
            raise SettingsError(f"{path}: not a policy (zip), model card (.json) or config (.yaml)")
        else:
            content = _policy(path)
        if content is None:
            return False
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
            temporary.chmod(path.stat().st_mode)
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror or error}") from None
    return True


# -- policies ----------------------------------------------------------------------------------------------------------


def _policy(path: Path) -> bytes | None:
    """The zip's bytes in the present format, or ``None`` if it has that already."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError) as error:
        raise PolicyError(f"{path}: damaged ({first_line(error)})") from None
    if _CHECKPOINT in names:
        raise PolicyError(f"{path}: a checkpoint, which is migrated when its training is resumed")
    if MEMBER not in names:
        raise PolicyError(f"{path}: saved by SB3 alone, without a config that could be migrated")
    loaded = load_policy(path)  # checks the members that it reads
    with zipfile.ZipFile(path) as archive, _damage_of(path):
        member = json.loads(read_member(archive, MEMBER, _MAX_JSON))
        number = member["format"]
        if number == FORMAT and not migrate_config(TrainingConfig, member["config"], number)[1]:
            return None
        kept = {name: read_member(archive, name, _MAX_MEMBER) for name in names if _stays(name, number)}
        data = json.loads(read_member(archive, "data", _MAX_MEMBER))
    check_clock()
    model = _fresh_model(loaded.config)
    model.policy.load_state_dict(loaded.policy.state_dict())
    stored, written = io.BytesIO(), io.BytesIO()
    model.save(stored, exclude=EPISODE_STATE)
    with zipfile.ZipFile(stored) as fresh, zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
        kept["data"] = _with_numbers_of(data, json.loads(fresh.read("data")))
        for name in fresh.namelist():
            archive.writestr(name, kept.get(name, fresh.read(name)))
        member = {**member, "format": FORMAT, "config": loaded.config.model_dump(mode="json")}
        archive.writestr(MEMBER, json.dumps(member, indent=1))
    return written.getvalue()


def _stays(name: str, number: int) -> bool:
    """Whether a member holds tensors or text that the present format has too; format 1 ordered the weights otherwise."""
    return name == "system_info.txt" or (name.endswith(".pth") and (number > 1 or name == "pytorch_variables.pth"))


def _fresh_model(config: TrainingConfig) -> OffPolicyAlgorithm:
    """An untrained model of the config, with room for hardly any transition."""
    algorithm = config.algorithm.replace(buffer_size=1)
    env = make_vec_env(config.scenario.replace(n_vehicles=1), 1, seed=0)
    try:
        return build_model(config.replace(algorithm=algorithm, device="cpu"), env)
    finally:
        env.close()


def _with_numbers_of(data: Mapping[str, Any], fresh: dict[str, Any]) -> bytes:
    """SB3's member ``data`` of a fresh model with the plain numbers of the file: counters, the buffer's size, ..."""
    for name, value in data.items():
        if name in fresh and all(type(number) in (int, float) for number in (value, fresh[name])):
            fresh[name] = value
    return json.dumps(fresh, indent=4).encode()


# -- model cards -------------------------------------------------------------------------------------------------------


def _card(path: Path) -> bytes | None:
    """The same for a model card: its config."""
    try:
        text = read_text(path, _MAX_CARD)
        card = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"{path}: not a JSON file ({first_line(error)})") from None
    if not isinstance(card, dict) or not isinstance(card.get("config"), dict) or "seeds" not in card:
        raise SettingsError(f"{path}: not a model card (it has no config and seeds)")
    with _errors_of(path):
        values, renamed = migrate_card(TrainingConfig, card)
    if card.get("format") == FORMAT and not renamed:
        return None
    with _errors_of(path):
        config = TrainingConfig(**values).model_dump(mode="json")
    migrated = {**card, "format": FORMAT, "config": config}
    return (json.dumps(migrated, indent=1) + "\n").encode()


# -- configs -----------------------------------------------------------------------------------------------------------


def _config(path: Path) -> bytes | None:
    """The same for a training's or a sweep's config."""
    values = read_yaml(path)
    text = read_text(path)
    if "grid" in values or "search" in values:
        current = _sweep(values)
        return None if current == values else _dump(current, text)
    with _errors_of(path):
        number = format_of(TrainingConfig, values)
        has_format = values.pop("format", None) is not None
        current, renamed = migrate_config(TrainingConfig, values, number)
        check_groups(TrainingConfig, current)
        config = TrainingConfig(**current)
    if number == FORMAT and not renamed:
        return None
    if set(current) == set(TrainingConfig.model_fields):
        return (_leading_comments(text) + to_yaml(config)).encode()
    return _dump({"format": FORMAT, **current} if has_format else current, text)


def _sweep(values: Mapping[str, Any]) -> dict[str, Any]:
    """A sweep's config with the present names of the fields that it varies or sets."""
    current = dict(values)
    for group in ("grid", "search"):
        if isinstance(values.get(group), Mapping):
            current[group] = {_present(key): value for key, value in values[group].items()}
    if isinstance(values.get("tasks"), list):
        current["tasks"] = [_present(task) for task in values["tasks"]]
    if isinstance(values.get("base"), Mapping):
        dotted = {_present(key): value for key, value in values["base"].items()}
        current["base"] = migrate_config(TrainingConfig, dotted, FORMAT)[0]
    if isinstance(values.get("policy"), str):
        current["policy"] = POLICIES.get(values["policy"], values["policy"])
    return current


_PATHS = [".".join(path) for path in leaf_paths(TrainingConfig)]


def _present(key: Any) -> Any:
    """A field's key, whole or without leading groups, under its present name."""
    known = not isinstance(key, str) or any(f".{path}".endswith(f".{key}") for path in _PATHS)
    return key if known else rename_key(key)


def _dump(values: Mapping[str, Any], text: str) -> bytes:
    plain = yaml.safe_dump(dict(values), sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    return (_leading_comments(text) + plain).encode()


def _leading_comments(text: str) -> str:
    lines = text.splitlines(keepends=True)
    return "".join(itertools.takewhile(lambda line: line.lstrip().startswith("#") or not line.strip(), lines))


@contextmanager
def _damage_of(path: Path) -> Iterator[None]:
    """Whatever zipfile and json raise for a damaged file."""
    try:
        yield
    except Exception as error:
        raise PolicyError(f"{path}: damaged ({first_line(error)})") from None


@contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    """Errors in a file's values, with the file's name."""
    try:
        yield
    except UserError as error:
        raise SettingsError(f"{path}: {error}") from None
