"""What the values of a checkpoint's state have to be. A file that is damaged, or edited, is noticed before it is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

_Count = Annotated[int, Field(strict=True, ge=0, le=10**15)]
_Number = Annotated[float, Field(strict=True)]
_Numbers = list[Annotated[float | None, Field(strict=True)]]


class _Values(BaseModel):
    model_config = ConfigDict(arbitrary_types_allowed=True, extra="ignore")


class _Replay(_Values):
    pos: _Count
    full: Annotated[bool, Field(strict=True)]
    arrays: dict[str, NDArray[Any]] = Field(min_length=1)
    last_places: NDArray[np.int64] | None = None

    @model_validator(mode="after")
    def _positions_are_rows(self) -> _Replay:
        rows = {len(array) for array in self.arrays.values()}
        if len(rows) > 1:
            raise ValueError(f"arrays of {sorted(rows)} rows")
        (used,) = rows
        if self.pos >= used or (not self.full and self.pos + 1 != used):
            raise ValueError(f"position {self.pos} in {used} rows")
        if self.last_places is not None and self.last_places.size:
            slots = min(array.shape[1] for array in self.arrays.values())
            if (self.last_places < 0).any() or (self.last_places >= (used, slots)).any():
                raise ValueError(f"last observations outside of {used} rows of {slots} slots")
        return self


class _Model(_Values):
    num_timesteps: _Count
    episodes_seen: _Count = Field(alias="_episode_num")
    n_updates: _Count = Field(alias="_n_updates")
    progress_remaining: float = Field(alias="_current_progress_remaining", strict=True, ge=0, le=1)
    episodes: list[dict[str, Any]]
    replay: _Replay


class _Rewards(_Values):
    returns: NDArray[Any]
    finished: _Numbers


class _Metrics(_Values):
    sums: dict[str, _Number]
    count: _Count


class _Evaluation(_Values):
    best_score: _Number
    last: _Count
    history: dict[str, _Numbers | list[_Numbers]]
    """``results`` and ``ep_lengths``, as in SB3's own file, have a list for each evaluation."""
    seconds: float = Field(strict=True, ge=0)

    @model_validator(mode="after")
    def _curves_are_of_one_length(self) -> _Evaluation:
        if len({len(curve) for curve in self.history.values()}) > 1:
            raise ValueError("curves of different lengths")
        return self


class _Parts(_Values):
    rewards: _Rewards
    metrics: _Metrics
    evaluation: _Evaluation


class _State(_Values):
    runtime_info: dict[str, str]
    model: _Model
    parts: _Parts


def check_state(state: Mapping[str, Any]) -> None:
    """Check the types and the ranges of what :func:`~sb3_flock.training.checkpoint.save_checkpoint` stores.

    :raises ValueError: one line that names the first value that cannot be
    """
    try:
        _State.model_validate(dict(state))
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
