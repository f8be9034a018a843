"""A reward term of your own: neighbors near a preferred distance."""

import sys

import numpy as np

from sb3_flock import Scenario, TrainingConfig, evaluate, flocking_v0, load_policy, register_reward_term, train


@register_reward_term("spacing")
def spacing(sensing, actions, ranges):
    """Minus the distances' deviations from the middle of minimum separation and link range [m], summed over the neighbors."""
    preferred = (ranges.neighbor_separation + ranges.link_range) / 2
    return -sensing.neighbors.sum(np.abs(sensing.neighbors.distances - preferred))


reward = {"extra_terms": {"spacing": 20.0}}
env = flocking_v0.parallel_env(Scenario(n_vehicles=3, arena=0.12, obstacle_arena=0.6, reward=reward))
env.reset(seed=1)
*_, infos = env.step({agent: np.array([0.1, 0.0]) for agent in env.agents})
for agent, info in infos.items():
    print(agent, {name: round(term, 4) for name, term in info["reward_terms"].items()})

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 150_000
config = TrainingConfig(scenario={"reward": reward}, total_timesteps=steps, n_flocks=8, eval_freq=0)
trained = load_policy(train(config).folder)
for name, policy in (("with the term", trained), ("without it, ddpg", load_policy("ddpg"))):
    separation = evaluate(policy, trained.scenario, episodes=50)["mean_separation_linked"].mean
    print(f"{name}: mean distance of linked vehicles {'none' if separation is None else f'{separation:.4f} m'}")
