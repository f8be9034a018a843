"""A controller of your own, by name in every comparison, and as an expert from which a policy learns."""

import sys

import numpy as np

from sb3_flock import Controller, TrainingConfig, evaluate, load_policy, make_controller, register_controller, train
from sb3_flock.controllers import register_expert
from sb3_flock.controllers.motion import steer


@register_controller("potential-field")
class PotentialField(Controller):
    """Drives to the waypoint, and away from bodies that are nearer than their minimum separation and a margin."""

    def act(self, sensing, scenario):
        velocities = sensing.waypoint_positions / scenario.time_step
        lengths = np.maximum(np.linalg.norm(velocities, axis=-1, keepdims=True), scenario.max_speed)
        velocities = velocities * scenario.max_speed / lengths
        for contacts, separation in (
            (sensing.neighbors, 1.2 * scenario.neighbor_separation),
            (sensing.obstacles, 1.2 * scenario.obstacle_separation),
        ):
            excess = np.maximum(separation / np.maximum(contacts.distances, 1e-6) - 1.0, 0.0)
            push = 10 * scenario.max_speed * excess[:, None] * contacts.positions
            push = push / np.maximum(contacts.distances, 1e-6)[:, None]
            velocities = velocities - np.stack([contacts.sum(axis) for axis in push.T], axis=-1)
        return steer(velocities, scenario)


register_expert("potential-field", lambda world, mpc: PotentialField())

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 150_000
settings = {"train_env": {"expert": "potential-field"}, "algorithm": {"bc_coef": 1.0, "learning_starts": 2000}}
student = load_policy(train(TrainingConfig(**settings, total_timesteps=steps, n_flocks=8, eval_freq=0)).folder)
for name in ("potential-field", "orca", "student"):
    metrics = evaluate(student if name == "student" else make_controller(name), student.scenario, episodes=50)
    print(f"{name:>15}: tracking error {metrics['tracking_error'].mean:.3f} m, ", end="")
    print(f"neighbor violations {metrics['neighbor_violation_rate'].mean:.2%}")
