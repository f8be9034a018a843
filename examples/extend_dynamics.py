"""Vehicle dynamics of your own, by name in training, evaluation and pictures: a double integrator, which drifts in curves."""

import sys

import numpy as np

from sb3_flock import TrainingConfig, VehicleDynamics, World, evaluate, load_policy, register_dynamics, render, train
from sb3_flock.sim.dynamics import directions_of, turn


@register_dynamics("double-integrator")
class DoubleIntegrator(VehicleDynamics):
    """The velocity changes towards the commanded one, along the heading, by at most the acceleration's bound."""

    memory = ("velocities",)

    def reset(self, rngs):
        super().reset(rngs)
        self.velocities = np.zeros((len(rngs), self.settings.n_vehicles, 2))

    def step(self, positions, headings, commands, dt):
        changes = commands[..., :1] * directions_of(headings) - self.velocities
        lengths = np.maximum(np.linalg.norm(changes, axis=-1), 1e-12)
        changes = changes * np.minimum(1.0, self.actuators.max_acceleration * dt / lengths)[..., None]
        positions = positions + (self.velocities + changes / 2) * dt
        self.velocities = self.velocities + changes
        return positions, turn(headings, commands[..., 1], dt)


steps = int(sys.argv[1]) if len(sys.argv) > 1 else 150_000
scenario = {"dynamics": "double-integrator", "actuators": {"max_acceleration": 0.3}, "safety_filter": "off"}
policy = load_policy(train(TrainingConfig(scenario=scenario, total_timesteps=steps, n_flocks=8, eval_freq=0)).folder)
world = World(policy.scenario)
start = world.reset([np.random.default_rng(0)])
print(f"speed in the first step: {np.hypot(*world.step([[[0.15, 0.0]] * 3])[0].ego_motion[0, 0, ::2]) / 0.1:.3f} m/s")
for name in ("double-integrator", "unicycle"):
    metrics = evaluate(policy, policy.scenario.replace(dynamics=name), episodes=50)
    print(f"{name:>17}: tracking error {metrics['tracking_error'].mean:.3f} m")
print(render(policy, policy.scenario, "extend_dynamics.png"))
