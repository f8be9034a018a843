"""A metric of your own: it appears in every table, log and JSON file."""

import sys

import numpy as np
from rich import print

from sb3_flock import evaluate, load_policy, make_controller, register_metric
from sb3_flock.evaluation import EpisodeMetric
from sb3_flock.evaluation.report import metrics_table


@register_metric
class ArrivalTime(EpisodeMetric):
    """First time at which every vehicle is within link range of the waypoint."""

    name, unit, better, column = "arrival_time", "s", "lower", "arrival"
    description = "first time at which every vehicle is within link range of the waypoint [s]"

    def __init__(self, scenario, n_flocks):
        super().__init__(scenario, n_flocks)
        self._time = np.full(n_flocks, np.nan)  # undefined for an episode in which they never arrive

    def update(self, step):
        arrived = (step.sensing.waypoint_distances < self.scenario.link_range).all(-1)
        self._time[arrived & np.isnan(self._time)] = step.number * self.scenario.time_step

    def result(self):
        return self._time


episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 200
policy = load_policy("ddpg")
for name, controller in (("ddpg", policy), ("orca", make_controller("orca"))):
    print(name, metrics_table(evaluate(controller, policy.scenario, episodes), policy.scenario))
