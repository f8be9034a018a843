import numpy as np
import pytest

from sb3_flock import make_vec_env
from sb3_flock.controllers import Controller
from sb3_flock.envs.expert_env import ExpertEnv
from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng
from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.randomization import UNBOUNDED, FlockValues, check_ranges, own_rngs, rng_states, rngs_of
from sb3_flock.sim.sensors import SensorErrors
from tests.helpers import assert_equal_rollouts

RANGES = {
    "actuators.speed_lag": (0.0, 0.3),
    "actuators.max_acceleration": (0.3, 2.0),
    "actuators.slip": (0.0, 0.1),
    "sensors.position_noise": (0.0, 0.02),
    "sensors.dropout": (0.0, 0.3),
    "sensors.delay": (0.0, 0.3),
    "sensors.field_of_view": (3.0, 6.28),
    "sensors.occlusion": (0.0, 0.05),
    "sensors.odometry_noise": (0.0, 0.1),
}
CROWD = Scenario(n_vehicles=6, n_obstacles=3, arena=0.3, obstacle_arena=0.6, motion_lag=0.2, max_cycles=25)


def driven(scenario, ranges, n_flocks, first=0, steps=20):
    """Everything measured and every position of some flocks that all do the same."""
    world = World(scenario, n_flocks, randomization=ranges)
    sensing = world.reset([episode_rng(0, first + flock) for flock in range(n_flocks)])
    seen = []
    for step in range(steps):
        measured = world.sensors.measure(sensing)
        for flock in range(n_flocks):
            rows = measured.neighbors.observers // scenario.n_vehicles == flock
            rows_before = measured.previous.neighbors.observers // scenario.n_vehicles == flock
            arrays = (
                world.positions[flock],
                measured.waypoint_positions[flock],
                measured.ego_motion[flock],
                measured.neighbors.bodies[rows],
                measured.neighbors.positions[rows],
                measured.previous.neighbors.positions[rows_before],
            )
            seen.append((step, first + flock, *(array.tolist() for array in arrays)))
        sensing, _ = world.step(np.full((n_flocks, scenario.n_vehicles, 2), (0.1, 0.7)))
    return world, sorted(seen)


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


def test_values_are_within_their_range_and_differ_between_flocks_and_episodes():
    world = World(CROWD, 400, randomization=RANGES)
    rngs = [episode_rng(0, flock) for flock in range(400)]
    world.reset(rngs)
    first = world.drawn
    assert first.keys() == RANGES.keys()
    for name, (low, high) in RANGES.items():
        values = first[name]
        assert len(set(values.tolist())) == 400
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.05 * (high - low))
    world.reset(rngs)
    assert (world.drawn["actuators.slip"] != first["actuators.slip"]).all()


def test_a_drawn_value_acts_as_the_same_value_of_the_scenario():
    fixed = {"actuators": {"speed_lag": 0.2, "max_acceleration": 0.5}, "sensors": {"field_of_view": 3.0, "delay": 0.2}}
    ranges = {f"{group}.{name}": (value, value) for group, names in fixed.items() for name, value in names.items()}
    plain = driven(CROWD.replace(**fixed), {}, 1)[0]
    drawn = driven(CROWD, ranges, 1)[0]
    # Only the flock's generator is at another place: the starts are drawn before.
    np.testing.assert_allclose(drawn.positions, plain.positions, atol=1e-12)
    ours, theirs = (world.sensors.measure(world.sense()) for world in (plain, drawn))
    np.testing.assert_array_equal(ours.neighbors.bodies, theirs.neighbors.bodies)
    np.testing.assert_allclose(ours.waypoint_positions, theirs.waypoint_positions, atol=1e-12)


def test_a_flock_of_a_batch_is_as_if_it_were_alone_with_its_values():
    together = driven(CROWD, RANGES, 4)[1]
    alone = sorted(row for flock in range(4) for row in driven(CROWD, RANGES, 1, first=flock)[1])
    assert together == alone


def test_without_ranges_nothing_is_drawn():
    rngs = [episode_rng(0, 0) for _ in range(2)]
    World(CROWD).reset(rngs[:1])
    World(CROWD, randomization={}).reset(rngs[1:])
    assert rngs[0].bit_generator.state == rngs[1].bit_generator.state


def test_a_vector_env_continues_from_its_state_in_the_middle_of_an_episode():
    one, other = (make_vec_env(CROWD, 3, seed=seed, randomization=RANGES) for seed in (0, 1))
    one.reset()
    other.reset()
    for _ in range(7):
        one.step(np.full((18, 2), 0.1, np.float32))
    other.load_state_dict(one.state_dict())
    for _ in range(40):  # over the end of the episode
        ours, theirs = (env.step(np.full((18, 2), 0.1, np.float32)) for env in (one, other))
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])


def test_the_values_are_the_same_in_one_process_and_in_workers():
    vec_envs = [make_vec_env(CROWD, 4, num_cpus, seed=0, randomization=RANGES) for num_cpus in (0, 2)]
    try:
        assert_equal_rollouts(*vec_envs, 30)
    finally:
        vec_envs[1].close()


class Seeing(Controller):
    """Remembers what it is shown."""

    def act(self, sensing, scenario):
        self.seen = sensing
        return np.zeros((*sensing.waypoint_distances.shape, 2))


@pytest.mark.parametrize("randomization", [None, {"sensors.position_noise": (0.1, 0.2)}])
@pytest.mark.parametrize("action_repeat", [1, 2])
def test_the_expert_senses_the_truth_with_its_motion_and_the_student_what_it_measures(randomization, action_repeat):
    noisy = CROWD if randomization else CROWD.replace(sensors=SensorErrors(position_noise=0.1))
    expert, exact_expert, repeat = Seeing(), Seeing(), {"action_repeat": action_repeat}
    env = ExpertEnv(noisy, lambda world: expert, 1.0, 0.0, n_flocks=2, randomization=randomization, **repeat)
    exact = ExpertEnv(CROWD, lambda world: exact_expert, 1.0, 0.0, n_flocks=2, **repeat)
    (observations, _), (exact_observations, _) = env.reset(seed=0), exact.reset(seed=0)
    for _ in range(4):
        for ours, theirs in ((expert.seen, exact_expert.seen), (expert.seen.previous, exact_expert.seen.previous)):
            np.testing.assert_array_equal(ours.waypoint_positions, theirs.waypoint_positions)
            np.testing.assert_array_equal(ours.neighbors.positions, theirs.neighbors.positions)
        assert any((observations[agent] != exact_observations[agent]).any() for agent in env.agents)
        actions = dict.fromkeys(env.agents, np.zeros(2, np.float32))
        (observations, rewards, *_), (exact_observations, exact_rewards, *_) = env.step(actions), exact.step(actions)
        assert rewards == exact_rewards
    other = ExpertEnv(noisy, lambda world: Seeing(), 1.0, 0.0, n_flocks=2, randomization=randomization, **repeat)
    other.load_state_dict(env.state_dict())
    for _ in range(4):
        env.step(actions)
        other.step(actions)
    np.testing.assert_array_equal(other.expert.seen.previous.waypoint_positions, expert.seen.previous.waypoint_positions)


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"sensors.dropot": (0, 0.1)}, r"sensors.dropot = \[0, 0.1\]: .*; did you mean sensors.dropout\?"),
        ({"n_vehicles": (1, 2)}, r"n_vehicles = \[1, 2\]: the name of a field of sensors or actuators is needed"),
        ({"sensors.dropout": (0.3, 0.1)}, r"sensors.dropout = \[0.3, 0.1\]: input should be the lowest and the highest"),
        ({"sensors.dropout": (0.3, 1.1)}, r"sensors.dropout = \[0.3, 1.1\]: input should be less than or equal to 1"),
        ({"actuators.slip": (0.3,)}, r"actuators.slip = \[0.3\]: input should be the lowest and the highest"),
        (
            {"actuators.min_speed": (0.0, 0.2)},
            r"actuators.min_speed = \[0.0, 0.2\]: input should be at most max_speed = 0.15",
        ),
    ],
)
def test_mistakes_are_one_line(ranges, message):
    with pytest.raises(SettingsError, match=rf"^randomization.{message}"):
        parallel_env(CROWD, randomization=ranges)


def test_bounds_that_are_off_by_default_have_ranges_too():
    check_ranges({"actuators.max_acceleration": (0.1, 1.0)}, {"actuators": Actuators()})
