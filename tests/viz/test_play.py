import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pygame
import pytest
from PIL import Image, ImageGrab

from sb3_flock.cli import main
from sb3_flock.controllers import Controller, make_controller
from sb3_flock.envs.rendering import HEADER, SIDE, Renderer
from sb3_flock.serialization.load import load_policy
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.sim.sensors import SensorErrors
from sb3_flock.viz.play import Game, play


@pytest.fixture
def game():
    return Game(make_controller("go-to-waypoint"), Scenario(n_vehicles=3, n_obstacles=1), seed=1)


def press(game, key, character=""):
    game.handle(pygame.event.Event(pygame.KEYDOWN, key=key, unicode=character))


def mouse(game, kind, pixels):
    button = {} if kind == pygame.MOUSEMOTION else {"button": 1}
    game.handle(pygame.event.Event(kind, pos=tuple(round(x) for x in pixels), **button))


def test_the_waypoint_is_dragged_and_stays_where_it_was_left(game):
    mouse(game, pygame.MOUSEBUTTONDOWN, game.renderer.pixels_of(game.world.waypoints[0]))
    place = np.array([0.4, -0.3])
    mouse(game, pygame.MOUSEMOTION, game.renderer.pixels_of(place))
    np.testing.assert_allclose(game.world.waypoints[0], place, atol=0.005)
    mouse(game, pygame.MOUSEBUTTONUP, game.renderer.pixels_of(place))
    mouse(game, pygame.MOUSEMOTION, game.renderer.pixels_of(-place))
    before = np.linalg.norm(game.world.positions[0] - place, axis=-1)
    for _ in range(20):
        game.step()
    np.testing.assert_allclose(game.world.waypoints[0], place, atol=0.005)
    assert (np.linalg.norm(game.world.positions[0] - place, axis=-1) < before).all()
    assert game.world.scenario.n_obstacles == 1  # a drag is not a click


def test_a_click_drops_an_obstacle_and_another_removes_it(game):
    place = game.renderer.pixels_of(np.array([0.9, 0.9]))
    mouse(game, pygame.MOUSEBUTTONDOWN, place)
    assert game.world.scenario.n_obstacles == 2
    np.testing.assert_allclose(game.world.obstacle_positions[0, 1], [0.9, 0.9], atol=0.005)
    game.step()
    first = game.world.obstacle_positions[0, 0].copy()
    mouse(game, pygame.MOUSEBUTTONDOWN, game.renderer.pixels_of(game.world.obstacle_positions[0, 1]))
    assert game.world.scenario.n_obstacles == 1
    np.testing.assert_array_equal(game.world.obstacle_positions[0, 0], first)
    mouse(game, pygame.MOUSEBUTTONDOWN, (SIDE + 20, 300))  # beside the arena
    assert game.world.scenario.n_obstacles == 1


def test_an_added_obstacle_walks(game):
    mouse(game, pygame.MOUSEBUTTONDOWN, game.renderer.pixels_of(np.array([0.5, 0.9])))
    before = game.world.obstacle_positions[0, 1].copy()
    for _ in range(5):
        game.step()
    assert 0 < np.linalg.norm(game.world.obstacle_positions[0, 1] - before) < 0.5 * 0.1


def test_vehicles_come_and_go_and_the_others_stay(game):
    others = game.world.positions.copy()
    press(game, pygame.K_PLUS, "+")
    assert game.world.scenario.n_vehicles == 4
    np.testing.assert_array_equal(game.world.positions[:, :3], others)
    game.step()
    for _ in range(6):
        press(game, pygame.K_MINUS)
    assert game.world.scenario.n_vehicles == 1  # one stays


def test_vehicles_with_actuators_keep_their_speeds_while_others_come_and_go():
    scenario = Scenario(n_vehicles=3, actuators={"speed_lag": 0.5, "slip": 0.05})
    game = Game(make_controller("go-to-waypoint"), scenario, seed=1)
    for _ in range(10):
        game.step()
    rates = game.world.dynamics.rates
    press(game, pygame.K_PLUS)
    np.testing.assert_array_equal(game.world.dynamics.rates[:, :3], rates)
    np.testing.assert_array_equal(game.world.dynamics.rates[:, 3], 0.0)
    for _ in range(2):
        press(game, pygame.K_MINUS)
    np.testing.assert_array_equal(game.world.dynamics.rates, rates[:, :2])
    game.step()
    assert (game.world.dynamics.rates != rates[:, :2]).any()


def test_pause_step_and_new_episode(game):
    press(game, pygame.K_SPACE)
    assert game.is_paused
    assert game.caption == "sb3_flock: 3 vehicles, 1 obstacle, paused"
    press(game, pygame.K_PERIOD)
    assert game.world.steps == 1
    here = game.world.positions.copy()
    press(game, pygame.K_r)
    assert game.world.steps == 0
    assert not np.array_equal(game.world.positions, here)
    press(game, pygame.K_q)
    assert game.is_over


def head_on(game):
    """Two vehicles at their separation that head for each other."""
    game.world.positions, game.world.headings = np.array([[(0.0, 0.0), (0.1, 0.0)]]), np.array([[0.0, -np.pi]])
    game.sensing = game.world.sense()
    game.step()
    return np.linalg.norm(game.world.positions[0, 1] - game.world.positions[0, 0])


class FullSpeed(Controller):
    """Drives straight ahead."""

    def act(self, sensing, scenario):
        return np.full((*sensing.waypoint_distances.shape, 2), (scenario.max_speed, 0.0))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"safety_filter": "heading"}, "heading"),
        ({"safety_filter": "voronoi", "obstacle_filter": True}, "voronoi + obstacles"),
    ],
)
def test_the_filter_of_the_scenario_acts_and_a_key_switches_it(fields, words):
    game = Game(FullSpeed(), Scenario(n_vehicles=2, n_obstacles=1, **fields))
    on = pygame.surfarray.array3d(game.draw())
    assert game.caption == f"sb3_flock: 2 vehicles, 1 obstacle, safety filter {words}"
    assert head_on(game) == 0.1
    press(game, pygame.K_f)
    assert game.caption == "sb3_flock: 2 vehicles, 1 obstacle"
    assert (pygame.surfarray.array3d(game.draw())[SIDE:] != on[SIDE:]).any()  # the panel says so, too
    assert head_on(game) == pytest.approx(0.07)
    press(game, pygame.K_r)
    assert not game.world.scenario.is_filtered
    press(game, pygame.K_f)
    press(game, pygame.K_r)
    assert head_on(game) == 0.1
    assert (game.filter_in_words, game.world.scenario.is_filtered) == (words, True)


def test_a_key_switches_a_filter_on_where_the_scenario_has_none():
    game = Game(FullSpeed(), Scenario(n_vehicles=2, n_obstacles=1))
    assert head_on(game) == pytest.approx(0.07)
    press(game, pygame.K_f)
    assert head_on(game) == 0.1
    assert "safety filter announce" in game.caption
    press(game, pygame.K_MINUS)
    press(game, pygame.K_PLUS, "+")
    assert head_on(game) == 0.1


def test_a_filter_that_cannot_be_on_stays_off():
    game = Game(FullSpeed(), Scenario(n_vehicles=2, n_obstacles=1, link_range=0.12))
    before = pygame.surfarray.array3d(game.draw())
    press(game, pygame.K_f)
    assert game.filter_in_words == "off"
    assert (pygame.surfarray.array3d(game.draw())[SIDE:] != before[SIDE:]).any()


def test_the_observation_of_each_vehicle_is_shown_in_turn(game):
    def panel():
        return pygame.surfarray.array3d(game.draw())[SIDE:]

    plain = panel()
    for vehicle in range(3):
        press(game, pygame.K_v)
        assert f"vehicle {vehicle} is watched" in game.caption
        assert (panel() < 100).sum() > (plain < 100).sum()
    press(game, pygame.K_v)
    np.testing.assert_array_equal(panel(), plain)


def test_an_episode_has_no_end(game):
    game.world.steps = game.world.scenario.max_cycles
    obstacle = game.world.obstacle_positions.copy()
    game.step()
    assert game.world.steps == 1
    assert np.linalg.norm(game.world.obstacle_positions - obstacle) < 0.02


def test_policies_and_controllers_with_memory_continue_while_the_flock_changes():
    late = SensorErrors(position_noise=0.01, delay=0.2)
    for policy, changes in (
        (load_policy("ddpg"), {}),
        (load_policy("ddpg"), {"sensors": late}),
        (load_policy("flock"), {"motion_lag": 0.2}),
        (make_controller("orca"), {}),
    ):
        task = getattr(policy, "scenario", Scenario())  # a policy's own, a controller has none
        game = Game(policy, task.replace(n_vehicles=2, n_obstacles=1, **changes))
        for key in (pygame.K_PLUS, pygame.K_PLUS, pygame.K_v, pygame.K_MINUS):
            press(game, key)
            game.step()
            game.draw()
        assert game.world.scenario.n_vehicles == 3


def test_the_loop_runs_in_real_time_and_ends(monkeypatch):
    seen = []
    monkeypatch.setattr(Game, "draw", lambda self: seen.append(self) or pygame.Surface((SIDE, HEADER)))
    monkeypatch.setattr(
        "sb3_flock.viz.play.pygame.event.get", lambda: [pygame.event.Event(pygame.QUIT)] if len(seen) > 20 else []
    )
    start = time.monotonic()
    play(make_controller("go-to-waypoint"), Scenario(), speed=4.0)
    assert 0 < seen[0].world.steps <= 40 * (time.monotonic() - start) + 1
    assert not pygame.display.get_init()


def test_mistakes_are_one_line(monkeypatch, capsys):
    with pytest.raises(SettingsError, match="speed = 0"):
        play(make_controller("random"), Scenario(), speed=0.0)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    monkeypatch.setenv("DISPLAY", ":12345")
    assert main(["play", "--controller", "random"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "no display to open a window on" in message
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.delenv("DISPLAY")
    assert main(["play", "--controller", "random"]) == 2


@pytest.fixture
def screen(monkeypatch):
    """An X server of its own. Without -noreset it would restart, and drop new clients, when its last client leaves."""
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-noreset", "-displayfd", str(write), "-screen", "0", "1000x800x24", "-nolisten", "tcp"],
        pass_fds=[write],
    )
    os.close(write)
    with os.fdopen(read) as number:
        display = f":{number.readline().strip()}"
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    yield display
    server.terminate()
    server.wait()


def color_at(screen, pixels):
    """The color of a pixel of the window, which alone is on the black screen."""
    colors = np.asarray(ImageGrab.grab(xdisplay=screen))
    corner = np.argwhere((colors == 255).all(-1)).min(0)
    return tuple(colors[corner[0] + round(pixels[1]), corner[1] + round(pixels[0])].tolist())


def wait_for_color(screen, pixels, color, seconds=30):
    """The window draws 30 times a second, or less often on a busy machine."""
    deadline = time.monotonic() + seconds
    while (found := color_at(screen, pixels)) != color:
        assert time.monotonic() < deadline, found
        time.sleep(0.05)


@pytest.mark.skipif(not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool")
def test_a_real_window_with_a_real_mouse_and_keys(screen):
    def xdotool(*words):
        return subprocess.run(["xdotool", *map(str, words)], check=False, capture_output=True, text=True).stdout.strip()

    def point_at(x, y):
        xdotool("mousemove", "--window", window, round(x), round(y))
        time.sleep(0.3)

    def wait_for(words, seconds=60):
        """The window with these words in its title: SDL may open another one first."""
        deadline = time.monotonic() + seconds
        while True:
            visible = xdotool("search", "--onlyvisible", "--class", ".").split()
            found = {number: xdotool("getwindowname", number) for number in visible}
            for number, title in found.items():
                if words in title:
                    return number
            assert (process.poll(), time.monotonic() < deadline) == (None, True), found
            time.sleep(0.05)

    command = [sys.executable, "-m", "sb3_flock.cli", "play", "--controller", "go-to-waypoint", "--n-vehicles", "4"]
    process = subprocess.Popen([*command, "--set", "waypoint_route=[[0.5, 0.5]]", "--set", "obstacle_max_speed=0"])
    try:
        window = wait_for("4 vehicles, 1 obstacle")
        point_at(60, HEADER + 60)
        xdotool("click", 1)
        wait_for("2 obstacles")
        xdotool("key", "space")
        wait_for("paused")
        point_at(160, HEADER + 60)
        xdotool("key", "plus")
        wait_for("5 vehicles")
        xdotool("key", "v")
        wait_for("vehicle 0 is watched")
        renderer = Renderer(Scenario(), "rgb_array", fps=0)
        here, there = renderer.pixels_of((0.5, 0.5)), renderer.pixels_of((0.8, -0.8))
        point_at(*here)
        xdotool("mousedown", 1)
        point_at(*there)
        xdotool("mouseup", 1)
        wait_for_color(screen, there, (0, 0, 0))  # the waypoint's cross
        wait_for_color(screen, (60, HEADER + 60), (204, 121, 167))  # the obstacle
        assert color_at(screen, here) != (0, 0, 0)
        point_at(60, HEADER + 60)
        xdotool("click", 1)
        wait_for("1 obstacle,")
        xdotool("key", "q")
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.wait()


def test_the_legend_fits():
    game = Game(make_controller("random"), Scenario(n_vehicles=2, n_obstacles=1))
    header = pygame.surfarray.array3d(game.draw())[SIDE - 6 : SIDE, :HEADER]
    assert Image.fromarray(header).convert("L").getextrema()[0] > 200
