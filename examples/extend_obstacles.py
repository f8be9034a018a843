"""A world of your own: obstacles that patrol on circles around the place where the flock gathers."""

import sys

import numpy as np

from sb3_flock import (
    ObstacleMotion,
    TrainingConfig,
    evaluate,
    load_policy,
    register_obstacle_motion,
    render,
    train,
)


@register_obstacle_motion("patrol")
class Patrol(ObstacleMotion):
    """Counterclockwise around the origin, at half the obstacles' top speed, 0.3 m away."""

    radius = 0.3

    def start(self, rng, waypoint):
        angle = rng.uniform(-np.pi, np.pi)
        return self.radius * np.array([np.cos(angle), np.sin(angle)])

    def headings(self, rng, starts, waypoint):
        return np.arctan2(starts[:, 1], starts[:, 0]) + np.pi / 2

    def controls(self, rng):
        speeds = np.full((self.settings.max_cycles, self.settings.n_obstacles), self.settings.obstacle_max_speed / 2)
        return speeds, speeds / self.radius


steps = int(sys.argv[1]) if sys.argv[1:] else 150_000
scenario = {"n_vehicles": 5, "n_obstacles": 2, "obstacle_motion": "patrol"}
policies = {"flock": load_policy("flock")}
config = TrainingConfig(scenario=scenario, total_timesteps=steps, n_flocks=8, eval_freq=0)
policies["trained with patrols"] = load_policy(train(config).folder)
for name, policy in policies.items():
    metrics = evaluate(policy, policy.scenario.replace(**scenario), episodes=50)
    print(
        f"{name:>20}: tracking error {metrics['tracking_error'].mean:.3f} m, free {metrics['violation_free_rate'].mean:.0%}"
    )
print(render(policies["flock"], policies["flock"].scenario.replace(**scenario), "extend_obstacles.png"))
