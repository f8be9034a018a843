"""Flying policies and judging the flights; it never trains one."""

from sb3_flock.evaluation.episodes import Controller, PolicyController, evaluate, fly
from sb3_flock.evaluation.metrics import METRICS, EpisodeMetrics, Metric, summarize

__all__ = ["METRICS", "Controller", "EpisodeMetrics", "Metric", "PolicyController", "evaluate", "fly", "summarize"]
