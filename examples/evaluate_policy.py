"""Fly a trained policy in a flock it was not trained for, and read its metrics."""

import sys

import numpy as np

from sb3_flock import evaluate, load_policy
from sb3_flock.viz.figures import lines, save_as

policy = load_policy(sys.argv[1])  # a zip or a run folder
fleets, curve = (2, 3, 5, 8), []
for n_vehicles in fleets:
    metrics = evaluate(policy, policy.scenario.replace(n_vehicles=n_vehicles), episodes=50, seed=1)
    tracking, too_close = metrics["tracking_error"], metrics["neighbor_violation_rate"]
    print(f"{n_vehicles} vehicles: tracking error {tracking.mean:.3f} m [{tracking.low:.3f}, {tracking.high:.3f}]", end=", ")
    print(f"too close in {100 * too_close.mean:.2f} % of the vehicle-steps")
    curve.append(tracking.mean)
figure = lines({"tracking error": (fleets, np.array(curve))}, "vehicles", "meters")
save_as(figure, "evaluate_policy.png", "png")
