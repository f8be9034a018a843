import numpy as np
import pytest

from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.randomization import UNBOUNDED, FlockValues, own_rngs, rng_states, rngs_of


def test_values_broadcast_over_flocks_and_a_missing_bound_is_unbounded():
    values = FlockValues(Actuators(speed_lag=0.2), {"slip": np.array([0.1, 0.3])})
    assert values.are_drawn
    np.testing.assert_array_equal(values.speed_lag * np.ones((2, 5)), np.full((2, 5), 0.2))
    np.testing.assert_array_equal(values.slip, [[0.1], [0.3]])
    np.testing.assert_array_equal(values.of_flocks("speed_lag", 2), [0.2, 0.2])
    np.testing.assert_array_equal(values.of_flocks("slip", 2), [0.1, 0.3])
    assert values.max_acceleration == UNBOUNDED
    assert not FlockValues(Actuators()).are_drawn
    with pytest.raises(AttributeError, match="speed"):
        _ = values.speed


def test_a_parts_generator_continues_from_its_state():
    rngs = own_rngs([np.random.default_rng(seed) for seed in range(3)])
    rngs[0].random(5)
    copies = rngs_of(rng_states(rngs))
    assert [rng.random() for rng in rngs] == [rng.random() for rng in copies]
    assert len({rng.random() for rng in rngs}) == 3
