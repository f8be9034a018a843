"""A policy beside a hand-written law on the same episodes: the numbers, and a picture of one flight of each."""

import sys

from sb3_flock import evaluate, load_policy
from sb3_flock.controllers import make_controller
from sb3_flock.viz.figures import flights, record, save_as

policy = load_policy(sys.argv[1] if len(sys.argv) > 1 else "ddpg-5v2o")
episodes = int(sys.argv[2]) if len(sys.argv) > 2 else 200
flyers = {"ours": policy, "Olfati-Saber": make_controller("olfati-saber")}
for name, flyer in flyers.items():
    metrics = evaluate(flyer, policy.scenario, episodes, seed=1)
    tracking, connected = metrics["tracking_error"], metrics["connectivity"]
    print(f"{name:>12}: tracking error {tracking.mean:.3f} m [{tracking.low:.3f}, {tracking.high:.3f}], ", end="")
    print(f"connected {connected.mean:.1%}, too close in {metrics['neighbor_violation_rate'].mean:.2%} of the vehicle-steps")
pictures = {name: record(flyer, policy.scenario, seed=1, episode=4) for name, flyer in flyers.items()}
save_as(flights(pictures), "beside_olfati_saber.png", "png")
