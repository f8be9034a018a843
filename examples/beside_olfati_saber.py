"""A policy and a baseline controller on the same episodes: the numbers, and a picture of one episode of each."""

import sys

from sb3_flock import evaluate, load_policy, make_controller
from sb3_flock.viz.figures import plot_side_by_side, record_trajectory, save_as

policy = load_policy(sys.argv[1] if len(sys.argv) > 1 else "ddpg")
episodes = int(sys.argv[2]) if len(sys.argv) > 2 else 200
controllers = {"ours": policy, "Olfati-Saber": make_controller("olfati-saber")}
for name, controller in controllers.items():
    metrics = evaluate(controller, policy.scenario, episodes, seed=1)
    tracking, connected = metrics["tracking_error"], metrics["connectivity"]
    print(f"{name:>12}: tracking error {tracking.mean:.3f} m [{tracking.low:.3f}, {tracking.high:.3f}], ", end="")
    print(f"connected {connected.mean:.1%}, separation violations {metrics['neighbor_violation_rate'].mean:.2%}")
trajectories = {
    name: record_trajectory(controller, policy.scenario, seed=1, episode=4) for name, controller in controllers.items()
}
save_as(plot_side_by_side(trajectories), "beside_olfati_saber.png", "png")
