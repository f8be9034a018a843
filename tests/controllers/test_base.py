import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.config.training import TrainEnvConfig
from sb3_flock.controllers import (
    CONTROLLERS,
    EXPERTS,
    Controller,
    make_controller,
    register_controller,
    register_expert,
)
from sb3_flock.controllers.mpc import MPCConfig
from sb3_flock.evaluation import rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng

SCENARIO = Scenario(n_vehicles=4, n_obstacles=2, arena=0.3, obstacle_arena=0.4, max_cycles=20)


class Circle(Controller):
    """Drives in a circle; everything else is the base class's."""

    def act(self, sensing, scenario):
        return np.broadcast_to((scenario.max_speed, 1.0), (*sensing.waypoint_distances.shape, 2))


@pytest.fixture(params=sorted(CONTROLLERS))
def controller(request):
    if request.param == "orca":
        pytest.importorskip("pyrvo")
    return make_controller(request.param)


def test_the_defaults_are_those_of_a_controller_without_memory():
    controller = Circle()
    controller.reset([episode_rng(0, 0)], SCENARIO)
    assert controller.state_dict() == {}
    controller.load_state_dict({})
    assert vars(controller) == {}
    assert rollout(controller, SCENARIO, 2, seed=0)["tracking_error"].shape == (2,)


def test_a_controller_has_to_act():
    class Idle(Controller):
        pass

    with pytest.raises(TypeError, match="act"):
        Idle()


def test_all_baselines_and_experts_are_controllers_and_registered():
    assert set(CONTROLLERS) == {"random", "go-to-waypoint", "olfati-saber", "orca"}
    assert set(EXPERTS) == {"mpc", "olfati-saber", "orca"}
    assert all(issubclass(controller, Controller) for controller in CONTROLLERS.values())


def test_numbers_repeat_and_do_not_depend_on_the_batch(controller):
    scenario = Scenario(n_vehicles=4, n_obstacles=2, max_cycles=60)
    one, other, again = (rollout(controller, scenario, 6, seed=3, batch=batch) for batch in (6, 4, 6))
    for name, values in one.items():
        np.testing.assert_allclose(values, other[name], rtol=1e-4, err_msg=name)  # RVO2 computes in single precision
        np.testing.assert_array_equal(values, again[name], err_msg=name)


def test_any_number_of_bodies_is_accepted(controller):
    for vehicles, obstacles in ((1, 0), (1, 3), (9, 0)):
        values = rollout(controller, Scenario(n_vehicles=vehicles, n_obstacles=obstacles, max_cycles=10), 2, seed=0)
        assert np.isfinite(values["tracking_error"]).all()


@pytest.mark.parametrize("name", sorted(EXPERTS))
def test_an_expert_continues_from_its_state(name):
    pytest.importorskip({"mpc": "numba", "orca": "pyrvo"}.get(name, "numpy"))
    world = World(SCENARIO, 2)
    rngs = [episode_rng(0, episode) for episode in range(2)]
    sensing = world.reset(rngs)
    config = MPCConfig(n_iterations=5)
    expert, other = EXPERTS[name](world, config), EXPERTS[name](world, config)
    assert isinstance(expert, Controller)
    for controller in (expert, other):
        controller.reset(rngs, SCENARIO)
    for _ in range(5):
        sensing, _ = world.step(expert.act(sensing, SCENARIO))
    other.load_state_dict(expert.state_dict())
    for _ in range(5):
        actions = expert.act(sensing, SCENARIO)
        np.testing.assert_array_equal(other.act(sensing, SCENARIO), actions)
        assert (actions >= world.action_low - 1e-9).all()
        assert (actions <= world.action_high + 1e-9).all()
        sensing, _ = world.step(actions)


def test_an_unknown_name_is_refused_with_all_names_and_the_nearest():
    with pytest.raises(SettingsError) as error:
        make_controller("olfati")
    message = str(error.value)
    assert message.startswith("controller = 'olfati': one of ")
    assert all(name in message for name in CONTROLLERS)
    assert message.endswith("; did you mean olfati-saber?")
    assert "\n" not in message


def test_a_registered_controller_is_made_by_its_name(restored):
    restored(CONTROLLERS)
    assert register_controller("circle")(Circle) is Circle
    assert register_controller("circle")(Circle) is Circle  # the same class again is no error
    assert isinstance(make_controller("circle"), Circle)
    metrics = evaluate(make_controller("circle"), Scenario(n_vehicles=1, n_obstacles=0, max_cycles=4), episodes=2)
    assert metrics["tracking_error"].n == 2
    with pytest.raises(SettingsError, match="circle"):
        make_controller("boids")
    with pytest.raises(ValueError, match="controller 'circle' is registered already"):
        register_controller("circle")(type("Other", (Circle,), {}))


def test_a_registered_expert_is_an_expert_of_the_config(restored):
    with pytest.raises(SettingsError, match="expert = 'circle': one of mpc, olfati-saber, orca or null is needed"):
        TrainEnvConfig(expert="circle")
    restored(EXPERTS)
    register_expert("circle", lambda world, mpc: Circle())
    assert TrainEnvConfig(expert="circle").expert == "circle"
    with pytest.raises(ValueError, match="expert 'circle' is registered already"):
        register_expert("circle", lambda world, mpc: Circle())
