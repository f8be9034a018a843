"""A channel of your own in the observation: the neighbors ahead of a vehicle. The exported ONNX graph has the channel, too."""

import sys

from sb3_flock import Scenario, TrainingConfig, evaluate, export, flocking_v0, load_policy, register_channel, train
from sb3_flock.sim import Channel
from sb3_flock.viz.figures import new_figure, save_as

register_channel(
    Channel(
        "ahead",
        source="neighbors",
        radius=lambda settings: settings.link_range,
        select=lambda positions: positions[:, 0] > 0,  # the body frame's x axis points forward
    )
)

task = {"extra_channels": ("ahead",)}
env = flocking_v0.parallel_env(Scenario(n_vehicles=5, arena=0.2, obstacle_arena=0.6, **task))
observation = env.reset(seed=1)[0]["vehicle_0"]
figure, axes = new_figure(8.0, 2.5, columns=len(observation))
for channel, image, axis in zip(env.scenario.channels, observation, axes, strict=True):
    axis.imshow(image, origin="lower", cmap="Greys")
    axis.set(title=channel.name, xlabel="left", ylabel="forward")
save_as(figure, "extend_channel.png", "png")

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 150_000
policy = load_policy(train(TrainingConfig(scenario=task, total_timesteps=steps, eval_freq=0)).folder)
print(f"observations of shape {policy.policy.observation_space.shape}")
print(f"tracking error {evaluate(policy, episodes=50)['tracking_error'].mean:.3f} m")
exported = export(policy, "extend_channel.onnx", n_samples=100)
print(f"the ONNX graph differs from the policy by at most {exported.difference:.1e} of the actions' range")
