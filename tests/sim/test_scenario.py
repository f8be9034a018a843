import pytest

from sb3_flock.settings import SettingsError
from sb3_flock.sim import RewardWeights, Scenario


def test_the_defaults_are_the_papers_numbers_where_it_gives_them():
    scenario = Scenario()
    assert (scenario.time_step, scenario.max_speed, scenario.obstacle_max_speed, scenario.waypoint_speed) == (
        0.1,
        0.15,
        0.1,
        0.1,
    )
    assert (scenario.link_range, scenario.neighbor_separation) == (0.15, 0.1)
    assert (scenario.detection_range, scenario.obstacle_separation) == (0.25, 0.15)
    assert (scenario.arena, scenario.n_anchors) == (1.0, 11)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"n_vehicles": 0}, ["n_vehicles", "0", "greater than or equal to 1"]),
        ({"n_obstacles": -1}, ["n_obstacles", "-1", "greater than or equal to 0"]),
        ({"max_speed": float("nan")}, ["max_speed", "nan", "finite"]),
        ({"time_step": 0}, ["time_step", "0", "greater than or equal to 0.000001"]),
        ({"n_anchors": 2.5}, ["n_anchors", "2.5", "integer"]),
        ({"n_vehicles": "many"}, ["n_vehicles", "many", "integer"]),
        ({"link_range": 0.05}, ["neighbor_separation", "0.1", "at most", "link_range", "0.05"]),
        ({"obstacle_separation": 0.3}, ["obstacle_separation", "0.3", "detection_range"]),
        ({"reward": {"lambda_": 1.5}}, ["lambda_", "1.5", "less than or equal to 1"]),
        ({"n_vehicle": 3}, ["n_vehicle", "did you mean n_vehicles?"]),
    ],
)
def test_a_wrong_value_is_one_line_with_name_value_and_what_is_accepted(fields, words):
    with pytest.raises(SettingsError) as error:
        Scenario(**fields)
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_replace_validates_and_leaves_the_original():
    scenario = Scenario()
    assert scenario.replace(n_vehicles=5).n_vehicles == 5
    assert scenario.n_vehicles == 3
    with pytest.raises(SettingsError, match="n_vehicles"):
        scenario.replace(n_vehicles=0)


def test_scenarios_are_frozen():
    with pytest.raises(Exception, match="frozen"):
        Scenario().n_vehicles = 4


def test_obstacles_share_the_arena_unless_theirs_is_set():
    assert Scenario(arena=3.0).obstacle_half_side == 3.0
    assert Scenario(arena=3.0, obstacle_arena=1.5).obstacle_half_side == 1.5


def test_channel_radii_default_to_the_sensing_radii():
    assert Scenario().channel_radii == (0.15, 0.25, 0.3)
    assert Scenario(neighbor_radius=0.3, obstacle_radius=0.5).channel_radii == (0.3, 0.5, 0.3)


def test_every_parameter_has_a_description():
    for settings in (Scenario, RewardWeights):
        for name, field in settings.model_fields.items():
            assert field.description, name


def test_equal_scenarios_are_one_key():
    known = {Scenario(): "default", Scenario(reward={"lambda_": 0.5}): "half"}
    assert known[Scenario().replace(n_vehicles=5).replace(n_vehicles=3)] == "default"
    assert known[Scenario(reward=RewardWeights(lambda_=0.5))] == "half"
    assert Scenario(n_vehicles=4) not in known
