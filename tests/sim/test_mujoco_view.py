import os
import subprocess
import sys

import pytest
from PIL import Image

from sb3_flock.cli import main
from sb3_flock.settings import RunError
from sb3_flock.sim import Scenario
from sb3_flock.sim.mujoco_view import HEIGHT, WIDTH, View

mujoco = pytest.importorskip("mujoco")

DRAW = """
import numpy as np
from sb3_flock.sim import Scenario, World, episode_rng
from sb3_flock.settings import RunError

scenario = Scenario(n_vehicles=2, dynamics="mujoco", obstacle_starts=[[0.3, 0.1]], waypoint_route=[[0.1, 0.0]])
world = World(scenario)
world.reset([episode_rng(0, 0)])

def draw():
    poses = np.concatenate((world.positions, world.headings[..., None]), axis=-1)
    return world.dynamics.image(poses, world.obstacle_positions[0], world.waypoints[0])

def colors():
    image = draw().astype(int)
    assert image.shape == ({height}, {width}, 3)
    red, green, blue = np.moveaxis(image, -1, 0)
    pink = (red > blue) & (blue > green + 20)
    cyan = (blue > red + 60)
    return pink.sum(), cyan.sum(), (image.max(-1) < 40).sum()

def placed(*xs):
    world.positions, world.headings = np.array([[[x, 0.0] for x in xs]]), np.zeros((1, len(xs)))
    world.step(np.zeros((1, 2, 2)))
    return colors()

try:
    start = colors()
except RunError as error:
    print("no OpenGL:", error)
    raise SystemExit
assert min(start) > 5, start  # also before the first step
linked, apart = placed(-0.06, 0.06), placed(-0.1, 0.1)
assert linked[0] > 500 and linked[2] > 50, linked
assert linked[1] - apart[1] > 50, (linked, apart)  # a link of this color
before = world.positions.copy(), world.dynamics._simulator._states[0].qacc_warmstart.copy()
draw()
assert (before[1] == world.dynamics._simulator._states[0].qacc_warmstart).all()  # a look changes nothing
print("drawn")
"""


@pytest.fixture
def draws():
    """Run a program with MuJoCo's renderer, which chooses its library when it is imported."""

    def run(words, library):
        environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"} | {"MUJOCO_GL": library}
        return subprocess.run(
            [sys.executable, *words], check=False, env=environment, capture_output=True, text=True, timeout=120
        )

    return run


def test_vehicles_links_obstacles_and_the_waypoint_are_shown(draws):
    done = draws(["-c", DRAW.format(height=HEIGHT, width=WIDTH)], "egl")
    if "no OpenGL" in done.stdout:
        pytest.skip(done.stdout)
    assert done.stdout == "drawn\n", done.stderr


def test_render_writes_the_simulators_view(draws, tmp_path):
    path = tmp_path / "wheels.gif"
    words = ["render", "--controller", "random", "--simulator", "mujoco", "--view", "simulator", "--set", "max_cycles=4"]
    done = draws(["-m", "sb3_flock.cli", *words, "-o", str(path)], "egl")
    if "cannot draw" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    with Image.open(path) as video:
        assert (video.size, video.n_frames) == ((WIDTH, HEIGHT), 5)


def test_without_opengl_one_line_names_what_is_needed():
    class Broken:
        class Renderer:
            def __init__(self, *_):
                raise ValueError("no display\nmore")

    with pytest.raises(RunError, match=r"MuJoCo cannot draw \(no display\).* MUJOCO_GL=egl"):
        View(Broken, None, Scenario())


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), "view = simulator: the dynamics are unicycle; a simulator is needed"),
        (("--simulator", "navground"), "view = simulator: the simulator navground shows no pictures"),
        (
            ("--simulator", "mujoco", "-o", "x.png"),
            "view = simulator: x.png shows paths; one of .gif, .mp4, .html is needed",
        ),
    ],
)
def test_a_view_that_there_is_not_is_refused_in_one_line(words, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if "navground" in words:
        pytest.importorskip("navground")
    assert main(["render", "--controller", "random", "--view", "simulator", "-o", "x.gif", *words]) == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith(line)
    assert list(tmp_path.iterdir()) == []


def test_render_refuses_a_view_from_python(tmp_path):
    from sb3_flock.controllers import make_controller
    from sb3_flock.settings import SettingsError
    from sb3_flock.viz.video import render

    with pytest.raises(SettingsError, match="view = plam: one of plan, simulator is needed; did you mean plan"):
        render(make_controller("random"), Scenario(), tmp_path / "x.gif", view="plam")
