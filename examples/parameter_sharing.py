"""Parameter sharing: every vehicle is a slot of the vector env, and one policy serves all slots."""

import numpy as np

from sb3_flock import Scenario, load_policy, make_vec_env

scenario = Scenario(n_vehicles=3, n_obstacles=1, arena=0.12, obstacle_arena=0.5)  # so small that they start as neighbors
env = make_vec_env(scenario, n_flocks=2, seed=0)  # 2 flocks of 3 vehicles: 6 slots, flock by flock
observations = env.reset()
policy = load_policy("ddpg")

actions, _ = policy.predict(observations)  # row s of the actions is computed from row s of the observations alone
alone = np.concatenate([policy.predict(observations[slot : slot + 1])[0] for slot in range(env.num_envs)])
print("slot  flock  vehicle  speed [m/s]  turn rate [rad/s]")
for slot, (speed, turn_rate) in enumerate(actions):
    print(f"{slot:4}  {slot // 3:5}  vehicle_{slot % 3}  {speed:11.3f}  {turn_rate:17.3f}")
print("computed alone, the same:", np.allclose(actions, alone, atol=1e-4))

_, _, _, infos = env.step(actions)
print("neighbors of each slot (numbers of vehicles in the same flock):", [info["neighbors"].tolist() for info in infos])
# One gradient step changes all vehicles: training fills one replay buffer with the transitions of every slot.
