"""Model cards: how a shipped policy was trained and how it performs, as JSON beside its zip.

Cards are read without torch; what writes them imports it.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation.metrics import Metric, columns
from sb3_flock.evaluation.robustness import evaluate_robustness
from sb3_flock.evaluation.rollout import evaluate
from sb3_flock.evaluation.tasks import TASKS, with_bodies_of
from sb3_flock.pretrained import shipped_policies
from sb3_flock.serialization.migrate import FORMAT, MEMBER
from sb3_flock.sim import Scenario

if TYPE_CHECKING:
    from sb3_flock.serialization.load import LoadedPolicy

CHECK_EPISODES, CHECK_SEED = 50, 7
"""The short evaluation whose tracking error a card records. The tests repeat it with every later version."""

ROBUSTNESS_EPISODES = 250
"""Episodes under each of the conditions that a card says what its policy bears in."""


def read_card(name: str) -> dict[str, Any]:
    """The card of a shipped policy: the commands, the learning curves and the results of its trainings."""
    card: dict[str, Any] = json.loads(shipped_policies()[name].with_suffix(".json").read_text(encoding="utf-8"))
    return card


def over_seeds(card: Mapping[str, Any], task: str | None = None) -> dict[str, Metric]:
    """Each metric that all trainings have: the median over them, the lowest and the highest.

    :param task: one of :data:`~sb3_flock.evaluation.tasks.TASKS`; otherwise the one that the policy was trained for
    """
    seeds = [seed["metrics"] if task is None else seed["tasks"][task] for seed in card["seeds"]]
    columns = {name: [metrics.get(name) for metrics in seeds] for name in seeds[0]}
    return {
        name: Metric(float(np.median(values)), min(values), max(values), len(values))
        for name, values in columns.items()
        if None not in values
    }


def ship(name: str, runs: Sequence[str | Path], folder: str | Path, episodes: int = 1000) -> Path:
    """Write the best policy as ``<name>.zip`` and the results of all trainings as ``<name>.json``.

    The evaluations during training choose the best policy; the results are from separate episodes.

    :param runs: run folders of finished trainings that differ in their seed
    :param folder: existing folder to write to
    :param episodes: number of episodes of each result
    :return: the path of the zip
    """
    from sb3_flock.serialization.load import load_policy

    folder, records, best = Path(folder), [], (np.inf, Path())
    for run in map(Path, runs):
        history = np.load(run / "evaluations.npz")
        records.append(_record(run, history, episodes))
        best = min(best, (float(history["score"].min()), run))
    _copy_light(load_policy(best[1]).path, folder / f"{name}.zip")
    shipped = load_policy(folder / f"{name}.zip")
    check = evaluate(shipped, episodes=CHECK_EPISODES, seed=CHECK_SEED)["tracking_error"].mean
    scenario = shipped.scenario
    card = {
        "format": FORMAT,
        "name": name,
        "task": f"{scenario.bodies} ({scenario.obstacle_motion})",
        "shipped_seed": shipped.config.seed,
        "episodes": episodes,
        "check": {"episodes": CHECK_EPISODES, "seed": CHECK_SEED, "tracking_error": check},
        "versions": shipped.versions,
        "seeds": records,
        "robustness": _robustness(shipped, ROBUSTNESS_EPISODES),
        "config": shipped.config.model_dump(mode="json"),
    }
    (folder / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    return folder / f"{name}.zip"


def _record(run: Path, history: Mapping[str, NDArray[np.float64]], episodes: int) -> dict[str, Any]:
    """The record of one training: its command, its length, its learning curve and its results."""
    from sb3_flock.serialization.load import load_policy

    policy = load_policy(run)
    tasks = {name: with_bodies_of(policy.scenario, task) for name, task in TASKS.items()}
    metrics: dict[Scenario, dict[str, float | None]] = {}
    for scenario in {policy.scenario, *tasks.values()}:
        means = evaluate(policy, scenario, episodes, seed=0)
        metrics[scenario] = {key: None if value.mean is None else round(value.mean, 5) for key, value in means.items()}
    return {
        "seed": policy.config.seed,
        "command": (run / "command.txt").read_text(encoding="utf-8").strip(),
        "transitions": int(history["timesteps"][-1]),
        "minutes": round(float(history["seconds"][-1]) / 60, 1),
        "metrics": metrics[policy.scenario],
        "tasks": {name: metrics[scenario] for name, scenario in tasks.items()},
        "curve": {key: history[key].round(4).tolist() for key in ("timesteps", "return", "tracking_error")},
    }


def _robustness(policy: LoadedPolicy, episodes: int) -> dict[str, Any]:
    """What the policy bears: the metrics of narrow tables under each of the conditions of ``evaluate --robustness``."""
    rows = evaluate_robustness(policy, policy.scenario, episodes)
    means = {name: {key: row[key].mean for key in columns()} for name, row in rows.items()}
    rounded = {name: {key: mean and round(mean, 5) for key, mean in row.items()} for name, row in means.items()}
    return {"episodes": episodes, "conditions": rounded}


def _copy_light(source: Path, target: Path) -> None:
    """Copy a policy at a quarter of its size: in half precision, with the networks' weights in place of their targets'.

    The config's ``output_dir`` is reset, because it names a folder of the training machine.
    """
    import torch as th

    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as copy:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "policy.pth":
                weights = th.load(io.BytesIO(content), weights_only=True)
                stored = io.BytesIO()
                halves = {key: weight.half() for key, weight in weights.items()}
                th.save({key: halves[key.replace("_target.", ".")] for key in halves}, stored)
                content = stored.getvalue()
            elif name == MEMBER:
                member = json.loads(content)
                member["config"]["output_dir"] = TrainingConfig().output_dir
                content = json.dumps(member, indent=1).encode()
            copy.writestr(name, content)
