"""Evaluate a trained policy in flocks of other sizes than it was trained for."""

import sys

import numpy as np

from sb3_flock import evaluate, load_policy
from sb3_flock.viz.figures import plot_lines, save_as

policy = load_policy(sys.argv[1])  # a zip or a run folder
flock_sizes, curve = (2, 3, 5, 8), []
for n_vehicles in flock_sizes:
    metrics = evaluate(policy, policy.scenario.replace(n_vehicles=n_vehicles), episodes=50, seed=1)
    tracking, violations = metrics["tracking_error"], metrics["neighbor_violation_rate"]
    print(f"{n_vehicles} vehicles: tracking error {tracking.mean:.3f} m [{tracking.low:.3f}, {tracking.high:.3f}]", end=", ")
    print(f"separation violations in {violations.mean:.2%} of the vehicle-steps")
    curve.append(tracking.mean)
figure = plot_lines({"tracking error": (flock_sizes, np.array(curve))}, "vehicles", "meters")
save_as(figure, "evaluate_policy.png", "png")
