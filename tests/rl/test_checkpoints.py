import functools

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock.rl.checkpoints import LoadedCheckpoint, checkpoint_paths
from sb3_flock.rl.training import resume, train
from tests.rl.test_training import quiet, tiny


class PowerError(Exception):
    pass


class PowerFails(BaseCallback):
    """The power fails after so many transitions."""

    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps >= self.steps:
            raise PowerError
        return True


def everything(result):
    """All that a training leaves, but for wall time."""
    checkpoint = LoadedCheckpoint(checkpoint_paths(result.folder)[-1], 10**9)
    state = {f"{name}/{key}": value for name, tensors in checkpoint.tensors.items() for key, value in flat(tensors)}
    checkpoint.state["parts"]["evaluation"].pop("seconds")
    checkpoint.state["parts"]["evaluation"]["history"].pop("seconds")
    for episode in checkpoint.state["model"]["episodes"]:
        episode.pop("t")
    state.update(flat(checkpoint.state))
    return state


def flat(tree, name=""):
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from flat(value, f"{name}/{key}")
    elif isinstance(tree, list | tuple):
        for index, value in enumerate(tree):
            yield from flat(value, f"{name}/{index}")
    else:
        yield name, tree.detach().numpy() if isinstance(tree, th.Tensor) else tree


LONG = {"scenario.max_cycles": 40, "save_freq": 120, "eval_freq": 180, "total_timesteps": 600, "buffer_size": 330}


@pytest.mark.parametrize(
    ("algo", "changes"),
    [("ddpg", {}), ("ddpg-stock", {}), ("td3", {"n_steps": 3}), ("sac", {}), ("ddpg", {"buffer_size": 10_000})],
)
def test_a_resumed_run_ends_like_one_never_interrupted_to_the_last_bit(tmp_path, algo, changes):
    one = train(tiny(tmp_path / "a", algo=algo, **{**LONG, **changes}), quiet())
    config = tiny(tmp_path / "b", algo=algo, **{**LONG, **changes})
    folder = tmp_path / "b" / "runs" / one.folder.name
    for steps in (200, 460):
        go_on = functools.partial(resume, folder) if folder.exists() else functools.partial(train, config)
        with pytest.raises(PowerError):
            go_on(quiet(), callbacks=[PowerFails(steps)])
        np.random.seed(steps)  # noqa: NPY002 - another process would have other streams
        th.manual_seed(steps)
    other = resume(folder, quiet())
    ours, theirs = everything(one), everything(other)
    assert ours.keys() == theirs.keys()
    assert len(ours) > 100
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)
