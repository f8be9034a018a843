"""Rollouts of policies and controllers, metrics and their tables."""

from typing import Any

from sb3_flock._renamed import renamed_member
from sb3_flock.evaluation.metrics import METRICS, EpisodeMetric, EpisodeMetrics, Metric, register_metric, summarize
from sb3_flock.evaluation.rollout import evaluate, rollout

__all__ = [
    "METRICS",
    "EpisodeMetric",
    "EpisodeMetrics",
    "Metric",
    "evaluate",
    "register_metric",
    "rollout",
    "summarize",
]


def __getattr__(name: str) -> Any:
    return renamed_member(__name__, name)
