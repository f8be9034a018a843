import copy

import numpy as np
import pytest

from sb3_flock.training.checkpoint_schema import check_state

ROWS, SLOTS = 5, 3
STATE = {
    "runtime_info": {"python": "3"},
    "model": {
        "num_timesteps": 12,
        "_episode_num": 0,
        "_n_updates": 3,
        "_current_progress_remaining": 0.5,
        "episodes": [{"r": 1.0, "l": 2, "t": 0.1}],
        "replay": {
            "pos": ROWS - 1,
            "full": False,
            "arrays": {"rewards": np.zeros((ROWS, SLOTS)), "dones": np.zeros((ROWS, SLOTS))},
            "last_places": np.array([[0, 2], [4, 0]]),
        },
    },
    "parts": {
        "rewards": {"returns": np.zeros(SLOTS), "finished": [1.0]},
        "metrics": {"sums": {"connected": 1.0}, "count": 4},
        "evaluation": {
            "best_score": float("inf"),
            "last": 0,
            "history": {"score": [1.0, 2.0], "results": [np.zeros(2), np.zeros(2)]},
            "seconds": 0.0,
        },
    },
}


def changed(path, value):
    state = copy.deepcopy(STATE)
    *groups, name = path.split(".")
    level = state
    for group in groups:
        level = level[group]
    level[name] = value
    return state


def test_a_state_that_a_training_stores_is_accepted():
    check_state(STATE)
    check_state(changed("model.replay.last_places", np.zeros((0, 2), np.int64)))
    full = changed("model.replay.full", True)
    full["model"]["replay"]["pos"] = 2
    check_state(full)


@pytest.mark.parametrize(
    ("path", "value", "why"),
    [
        ("model.num_timesteps", -1, "greater than or equal to 0"),
        ("model.num_timesteps", 1.0, "valid integer"),
        ("model.num_timesteps", True, "valid integer"),
        ("model._n_updates", "3", "valid integer"),
        ("model._current_progress_remaining", 1.5, "less than or equal to 1"),
        ("model._current_progress_remaining", float("nan"), ""),
        ("model.episodes", "none", "valid list"),
        ("model.replay.pos", ROWS, "position 5 in 5 rows"),
        ("model.replay.pos", 2, "position 2 in 5 rows"),
        ("model.replay.full", 1, "valid boolean"),
        ("model.replay.arrays", {}, "at least 1"),
        ("model.replay.arrays.dones", np.zeros((ROWS - 1, SLOTS)), "arrays of [4, 5] rows"),
        ("model.replay.last_places", np.array([[0, SLOTS]]), "last observations outside of 5 rows of 3 slots"),
        ("model.replay.last_places", np.array([[-1, 0]]), "last observations outside"),
        ("parts.rewards.returns", [0.0], "instance of ndarray"),
        ("parts.metrics.count", -4, "greater than or equal to 0"),
        ("parts.evaluation.seconds", -1.0, "greater than or equal to 0"),
        ("parts.evaluation.history", {"score": [1.0], "timesteps": [1, 2]}, "curves of different lengths"),
        ("parts.evaluation.best_score", None, "valid number"),
        ("runtime_info", None, "valid dictionary"),
    ],
)
def test_what_cannot_be_is_named(path, value, why):
    with pytest.raises(ValueError, match=path.split(".")[0]) as error:
        check_state(changed(path, value))
    message = str(error.value)
    assert message.startswith(path.split(".")[0])
    assert why in message
    assert "\n" not in message
