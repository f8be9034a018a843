import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation.report import PAPER
from sb3_flock.evaluation.tasks import CROSSING, EXPERIMENTS, TASKS, with_bodies_of
from sb3_flock.sim import Scenario


def test_the_experiments_are_the_papers_and_without_a_filter():
    assert {(task.n_vehicles, task.n_obstacles) for task in EXPERIMENTS.values()} == set(PAPER)
    for name, task in EXPERIMENTS.items():
        assert name == f"{task.n_vehicles}v{task.n_obstacles}o"
        assert task.replace(n_vehicles=3, n_obstacles=1) == Scenario()
    assert {task.obstacle_motion for task in CROSSING.values()} == {"crossing"}
    assert list(TASKS) == [*EXPERIMENTS, *CROSSING]


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_policys_scenario_takes_the_bodies_of_a_task_and_keeps_the_rest(task):
    own = TrainingConfig(scenario={"n_vehicles": 9, "motion_lag": 0.2, "obstacle_radius": 0.35, "arena": 2.0}).scenario
    changed = with_bodies_of(own, task)
    bodies = {"n_vehicles": task.n_vehicles, "n_obstacles": task.n_obstacles, "obstacle_motion": task.obstacle_motion}
    assert changed == own.replace(**bodies)
    assert {name: getattr(changed, name) for name in bodies} == bodies
    assert (changed.safety_filter, changed.motion_lag, changed.arena) == ("announce", 0.2, 2.0)
    assert own.n_vehicles == 9
