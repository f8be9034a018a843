"""Every earlier format of our files, read into the present one.

Zips, checkpoints and whole configs carry a format number. Format 1 flattened the features channel by channel, format 2 anchor
by anchor; format 3 renamed fields, values and modules (:mod:`sb3_flock._renamed`); with format 4 the task of a training has
the safety filter unless it says otherwise.
The module is importable without torch.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_flock._renamed import rename_fields
from sb3_flock.settings import Settings, SettingsError, format_value, group_of
from sb3_flock.sim import Scenario

FORMAT = 4
"""The format that this version writes."""

MEMBER = "flock.json"
"""The JSON member of our zips: format, config, number of transitions and versions."""


def check_format(number: Any) -> int:
    """The number of a format that this version reads.

    :raises SettingsError: for any other
    """
    if isinstance(number, int) and 1 <= number <= FORMAT:
        return number
    raise SettingsError(f"format = {format_value(number)}: this version reads formats 1 to {FORMAT}")


def format_of(settings: type[Settings], values: Mapping[str, Any]) -> int:
    """The format of a config file's values: its number, or what its names tell. Files had no number up to format 2.

    :raises SettingsError: for a number that this version does not read
    """
    if "format" in values:
        return check_format(values["format"])
    return 2 if _rename(settings, values, "")[1] else FORMAT


def migrate_config(
    settings: type[Settings], values: Mapping[str, Any], number: int
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """A config's values in the present format, and what was renamed as (old, new) pairs.

    :param settings: the class that the values are of
    :param values: a mapping of fields, whole or in part
    :param number: the format of the values; with the present one old names are read all the same
    """
    current, renamed = _rename(settings, _without_max_vehicles(values), "")
    if number < 3 or renamed:
        _drop_idle_options(current)
    if number < 4:
        _fill_in(settings, current)
    return current, renamed


def migrate_card(settings: type[Settings], card: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """:func:`migrate_config` for the config in a model card; the first cards had no format number.

    :raises SettingsError: for a format that this version does not read
    """
    return migrate_config(settings, card["config"], check_format(card.get("format", 3)))


def _rename(
    settings: type[Settings], values: Mapping[str, Any], prefix: str
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    # A class that inherits its fields reads the old names of its own class name alone.
    current, names = rename_fields(settings.__name__, values)
    renamed = [(prefix + old, prefix + new) for old, new in names]
    for name, value in current.items():
        field = settings.model_fields.get(name) if isinstance(name, str) else None
        group = None if field is None else group_of(field.annotation)
        if group is not None and isinstance(value, Mapping):
            current[name], inner = _rename(group, value, f"{prefix}{name}.")
            renamed += inner
    return current, renamed


def _without_max_vehicles(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The first configs bounded the flock size, had no time step of their own, and scaled no separation to obstacles."""
    practice = values.get("practice")
    if not isinstance(practice, Mapping) or "max_vehicles" not in practice:
        return values
    n_vehicles = dict(values.get("scenario", {})).get("n_vehicles", 3)
    others = {name: value for name, value in practice.items() if name != "max_vehicles"}
    then = {"time_step_ratio": 1.0, "obstacle_separation_ratio": 1.0}
    sizes = (min(n_vehicles, practice["max_vehicles"]),)
    learner = {"mirror": False, **values.get("learner", {})}
    return {**values, "practice": {**then, **others, "vehicles": sizes}, "learner": learner}


_BEFORE_FORMAT_4: dict[str, dict[str, Any]] = {
    "scenario": {
        "safety_filter": "off",
        "shared_detections": False,
        "reward": {"link_bonus": 0.5, "lambda_": 0.7},
    },
    "train_env": {
        "flock_sizes": (4,),
        "extra_obstacles": 1,
        "time_step_scale": 2.0,
        "action_repeat": 1,
        "separation_scale": 1.06,
        "obstacle_separation_scale": None,
    },
}
"""The defaults that format 4 changed, as they were. They stand for the fields that a file of an earlier format leaves out,
because the file is a part of a config, or because the release that wrote the file did not have the field."""


def _fill_in(settings: type[Settings], values: dict[str, Any]) -> None:
    for group, then in _BEFORE_FORMAT_4.items():
        if group in settings.model_fields and isinstance(values.get(group, {}), Mapping):
            values[group] = _filled(then, values.get(group, {}))
    scenario = values.get("scenario")
    if isinstance(scenario, dict) and scenario.get("shared_detections") and scenario.get("obstacle_radius") is None:
        # The default of the obstacle channel's range did not grow with the detections of the neighbors.
        scenario["obstacle_radius"] = scenario.get("detection_range", Scenario().detection_range)


def _filled(then: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A group's values, with earlier defaults for the fields that it leaves out."""
    filled = {**then, **values}
    for name, inner in then.items():
        if isinstance(inner, Mapping) and isinstance(filled[name], Mapping):
            filled[name] = _filled(inner, filled[name])
    return filled


def _drop_idle_options(values: dict[str, Any]) -> None:
    """Earlier formats wrote options that did not apply to the algorithm, and ignored them; they are refused now."""
    algo = values.get("algo", "ddpg")
    algorithm, network = values.get("algorithm"), values.get("network")
    if isinstance(algorithm, dict) and (algo == "ddpg-sb3" or algorithm.get("n_steps", 1) != 1):
        algorithm.pop("mirror_augmentation", None)
    if isinstance(network, dict) and algo == "sac":
        network.pop("action_bound", None)


def migrate_weights(weights: Mapping[str, Any], number: int) -> dict[str, Any]:
    """The tensors of a policy in the present format.

    Up to format 1 the dense layer behind the convolutions took features flattened channel by channel.
    """
    if number > 1:
        return dict(weights)
    current = dict(weights)
    for name, tensor in weights.items():
        if not name.endswith("dense.0.weight"):
            continue
        convolutions = name.removesuffix("dense.0.weight") + "cnn."
        layers = [key for key in weights if re.fullmatch(re.escape(convolutions) + r"\d+\.weight", key)]
        features = len(weights[max(layers, key=lambda key: int(key.rsplit(".", 2)[1]))])
        by_channel = tensor.view(len(tensor), features, -1)
        current[name] = by_channel.permute(0, 2, 1).reshape(len(tensor), -1).contiguous()
    return current


_STATE_KEYS = {
    "looks": "history",
    "moved": "ego_motion",
    "earlier": "previous",
    "taught": "expert",
    "advice": "expert_actions",
    "planned": "next_actions",
    "wanted": "velocities",
    "surroundings": "runtime_info",
}
"""Old to new keys of a checkpoint's state."""


def migrate_state(state: Any, number: int) -> Any:
    """The state of a training in a checkpoint, in the present format."""
    current = state if number >= 3 else _rename_state(state)
    model = current.get("model", {})
    if _is_of_one_flock(model.get("env")):
        current = {**current, "model": {**model, "env": [_join_flocks(model["env"])]}}
    return current


def _rename_state(state: Any) -> Any:
    if isinstance(state, Mapping):
        current = {_STATE_KEYS.get(key, key): _rename_state(value) for key, value in state.items()}
        if "expert" in current and isinstance(current["expert"], dict):
            # The first files with an expert did not store its action apart from the noisy one.
            current["expert"].setdefault("expert_actions", current["expert"].get("next_actions"))
        return current
    return [_rename_state(value) for value in state] if isinstance(state, list) else state


def _is_of_one_flock(env: Any) -> bool:
    """Whether an env's state is a list of states of one flock each: the first checkpoints kept every flock's own env."""
    first = env[0] if isinstance(env, list) and env else {}
    return "rng" in (first["flocks"][0] if "flocks" in first else first)


def _join_flocks(flocks: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The state of an env with all flocks, from those of envs with one flock each."""
    if "flocks" in flocks[0]:  # several sizes: every state has one flock of each
        return {
            "flocks": [_join_flocks(same_size) for same_size in zip(*(state["flocks"] for state in flocks), strict=True)]
        }
    world = _join([state["world"] for state in flocks])
    joined = {"world": world, "rngs": [state["rng"] for state in flocks]}
    if "expert" not in flocks[0]:
        return joined
    acting = [state["expert"] for state in flocks if state["expert"] is not None]
    if not acting:
        return {**joined, "expert": None}
    driven = [expert["next_actions"] for expert in acting if expert["next_actions"] is not None]
    expert = {
        "drives": np.array([bool(state["expert"]) and state["expert"]["next_actions"] is not None for state in flocks]),
        "expert_actions": np.stack([expert["expert_actions"] for expert in acting]),
        "next_actions": np.stack(driven) if driven else None,
        "memory": _join([expert["memory"] for expert in acting]),
    }
    vehicles = world["positions"].shape[1]
    for name, bodies in (("neighbors", vehicles), ("obstacles", world["obstacle_positions"].shape[1])):
        if name in expert["memory"]:  # numbers of the pairs of a vehicle and a body, counted through all flocks
            keys = [expert["memory"][name]["keys"] + flock * vehicles * bodies for flock, expert in enumerate(acting)]
            expert["memory"][name]["keys"] = np.concatenate(keys)
    return {**joined, "expert": expert}


def _join(parts: Sequence[Any], name: str = "") -> Any:
    """States of one flock each as one: arrays along the axis of the flocks, what is the same for all of them once."""
    first = parts[0]
    if name == "rngs":
        return [rng for part in parts for rng in part]
    if isinstance(first, list):
        return [_join(items) for items in zip(*parts, strict=True)]
    if isinstance(first, np.ndarray):
        return np.concatenate(parts, axis=1 if name in ("obstacle_speeds", "obstacle_turn_rates") else 0)
    if not isinstance(first, Mapping):
        return first
    joined = {key: _join([part[key] for part in parts], key) for key in first}
    if "observers" in first:  # contacts
        vehicles = first["shape"][1]
        joined["observers"] = np.concatenate([part["observers"] + flock * vehicles for flock, part in enumerate(parts)])
        joined["shape"] = [len(parts), vehicles]
    return joined
