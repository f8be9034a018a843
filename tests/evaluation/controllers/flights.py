"""What the tests of teachers share."""

import numpy as np

from sb3_flock.evaluation.episodes import fly_together
from sb3_flock.sim import episode_rng


def flown(pilot, scenario, episodes):
    """The mean of each metric over some flights of who sees the world."""
    results = fly_together(pilot, scenario, [episode_rng(5, episode) for episode in range(episodes)])
    return {name: np.nanmean(values) for name, values in results.items()}
