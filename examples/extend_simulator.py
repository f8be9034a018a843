"""Vehicles of your own behind `reset` and `step`: robots with the usual two calls, a velocity command and a pose."""

import math
import sys

import numpy as np

from sb3_flock import Simulator, evaluate, load_policy, register_simulator, render


class Robot:
    """Stands for a robot's driver, whose motors turn in steps of 0.01 m/s and 0.1 rad/s."""

    def __init__(self, x, y, heading):
        self.x, self.y, self.heading, self.twist = x, y, heading, (0.0, 0.0)

    def set_velocity(self, linear, angular):
        self.twist = (round(linear, 2), round(angular, 1))

    def wait(self, seconds):
        linear, angular = self.twist
        halfway = self.heading + angular * seconds / 2
        self.x += linear * seconds * math.cos(halfway)
        self.y += linear * seconds * math.sin(halfway)
        self.heading += angular * seconds


@register_simulator("robots")
class Robots(Simulator):
    def reset(self, poses):
        self.flocks = [[Robot(*pose) for pose in flock] for flock in poses]

    def step(self, commands):
        for flock, twists in zip(self.flocks, commands, strict=True):
            for robot, twist in zip(flock, twists, strict=True):
                robot.set_velocity(*twist)
                robot.wait(self.settings.time_step)
        return np.array([[(robot.x, robot.y, robot.heading) for robot in flock] for flock in self.flocks])


policy = load_policy("flock")
for name in ("robots", "unicycle"):
    metrics = evaluate(policy, policy.scenario.replace(dynamics=name), episodes=int(sys.argv[1]) if sys.argv[1:] else 100)
    print(f"{name:>8}: tracking error {metrics['tracking_error'].mean:.4f} m")
print(render(policy, policy.scenario.replace(dynamics="robots"), "extend_simulator.png"))
