"""A training that Weights & Biases shows while it runs: its config, its curves, its best policy (pip install wandb)."""

import sys

import wandb

from sb3_flock import TrainingConfig, train

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
config = TrainingConfig(total_timesteps=steps, n_flocks=8)
with wandb.init(project="flocking", config=config.model_dump(mode="json"), sync_tensorboard=True) as run:
    result = train(config)  # its TensorBoard events go to W&B as they are written
    run.log_artifact(str(result.best_model), name="policy", type="model")
print(f"{result.best_model} is an artifact of the run {run.id}")
