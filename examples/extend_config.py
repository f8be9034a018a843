"""A parameter of your own around a training: validated, described, and read from YAML and from key=value."""

import sys

from pydantic import Field
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import TrainingConfig, train
from sb3_flock.serialization.yaml_io import load_config, parse_overrides, to_yaml
from sb3_flock.settings import Settings


class Experiment(Settings):
    """A training with weight decay."""

    weight_decay: float = Field(1e-4, ge=0, le=1, description="weight decay of both optimizers")
    training: TrainingConfig = Field(default_factory=TrainingConfig, description="the training")


class WeightDecay(BaseCallback):
    """Sets the optimizers' weight decay."""

    def __init__(self, weight_decay):
        super().__init__()
        self.weight_decay = weight_decay

    def _on_training_start(self):
        for part in (self.model.actor, self.model.critic):
            part.optimizer.param_groups[0]["weight_decay"] = self.weight_decay
            print(f"weight decay of {type(part).__name__}: {part.optimizer.param_groups[0]['weight_decay']:g}")

    def _on_step(self):
        return True


experiment = load_config(Experiment, overrides=parse_overrides(sys.argv[1:]))  # a file: load_config(Experiment, "my.yaml")
print("\n".join(to_yaml(experiment).splitlines()[:5]))
result = train(experiment.training, callbacks=[WeightDecay(experiment.weight_decay)])
print(f"trained: {result.folder}")
