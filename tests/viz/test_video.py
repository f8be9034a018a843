import re
import shutil

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from sb3_flock.cli import main
from sb3_flock.controllers import Controller, make_controller
from sb3_flock.envs.rendering import HEADER, PALETTE, SIDE
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.viz.video import render
from tests.browser import Browser

SCENARIO = Scenario(max_cycles=30)
_, _, _, _, _, VIOLATION, _, _ = PALETTE


@pytest.fixture
def controller():
    return make_controller("go-to-waypoint")


def test_a_gif_moves_in_the_time_it_should(tmp_path, controller):
    path = render(controller, SCENARIO, tmp_path / "episode.gif", speed=2.0)
    with Image.open(path) as video:
        assert video.size == (SIDE, HEADER + SIDE)
        assert video.n_frames == 31
        assert video.info["duration"] == 50
        assert video.info["loop"] == 0
        first = np.asarray(video.convert("RGB"))
        video.seek(30)
        assert (np.asarray(video.convert("RGB")) != first).any(-1).mean() > 0.005
    for color in PALETTE:
        assert (np.abs(first.astype(int) - color).max(-1) < 12).any()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("safety_filter", ["off", "voronoi"])
def test_the_filter_of_the_scenario_acts(safety_filter, tmp_path, controller):
    """Vehicles that violate their separation are drawn in another color; the filter leaves none."""
    scenario = Scenario(n_vehicles=6, n_obstacles=0, arena=0.4, max_cycles=60, safety_filter=safety_filter)
    with Image.open(render(controller, scenario, tmp_path / "episode.gif")) as video:
        violations = 0
        for frame in range(video.n_frames):
            video.seek(frame)
            picture = np.asarray(video.convert("RGB"))[HEADER:].astype(int)
            violations += (np.abs(picture - VIOLATION).max(-1) < 12).sum()
    assert (violations > 100) == (safety_filter == "off")
    assert violations == 0 or safety_filter == "off"


@pytest.mark.parametrize(("speed", "frames", "fps"), [(1.0, 31, 10), (20.0, 8, 50)])
def test_an_mp4_is_one(tmp_path, controller, speed, frames, fps):
    path = render(controller, SCENARIO, tmp_path / "episode.mp4", speed=speed)
    n_frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert n_frames == frames
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    reader.close()
    assert meta["size"] == (SIDE, HEADER + SIDE)
    assert meta["fps"] == fps
    assert meta["codec"] == "h264"


@pytest.mark.parametrize(("kind", "begin"), [("png", b"\x89PNG"), ("svg", b"<?xml")])
def test_figures(tmp_path, controller, kind, begin):
    path = render(controller, SCENARIO, tmp_path / f"episode.{kind}")
    assert path.read_bytes().startswith(begin)
    assert list(tmp_path.iterdir()) == [path]


def test_a_page_holds_everything_in_itself(tmp_path, controller):
    path = render(controller, SCENARIO, tmp_path / "episode.html", title="a < b & c")
    page = path.read_text()
    assert "<h1>a &lt; b &amp; c</h1>" in page
    assert not re.search(r"https?:|<script", page)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not shutil.which("chromedriver"), reason="needs Chromium and chromedriver")
def test_a_page_plays_in_a_browser(tmp_path, controller):
    path = render(controller, SCENARIO, tmp_path / "episode.html", speed=1.0)
    with Browser() as browser:
        browser.open(path.as_uri())
        player = "const player = document.querySelector('video');"
        browser.wait_for(player + "return player.currentTime > 0.3 && !player.paused && player.videoWidth == 640")
        browser.run(player + "player.pause(); player.currentTime = 2")
        browser.wait_for(player + "return player.paused && !player.seeking && player.currentTime == 2")
        browser.run(player + "player.play()")
        browser.wait_for(player + "return player.currentTime > 2.3")
        assert browser.console() == []


def test_mistakes_are_reported_before_the_simulation(tmp_path):
    class Never(Controller):
        def act(self, sensing, scenario):
            raise AssertionError

    for name, speed, message in (
        ("episode.avi", 1.0, "ends in .gif, .mp4, .html, .png, .svg"),
        ("there/episode.gif", 1.0, "there is no folder"),
        ("episode.gif", float("nan"), "speed = nan"),
    ):
        with pytest.raises(SettingsError, match=re.escape(message)):
            render(Never(), SCENARIO, tmp_path / name, speed=speed)


def test_an_older_video_stays_if_the_simulation_fails(tmp_path):
    class Fails(Controller):
        def act(self, sensing, scenario):
            raise RuntimeError

    path = tmp_path / "episode.mp4"
    path.write_bytes(b"older")
    with pytest.raises(RuntimeError):
        render(Fails(), SCENARIO, path)
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_the_command(tmp_path, capsys):
    path = tmp_path / "episode.gif"
    words = ["render", "ddpg", "--n-vehicles", "2", "--set", "max_cycles=3", "--output", str(path)]
    assert main(words) == 0
    assert capsys.readouterr().out == f"{path}\n"
    with Image.open(path) as video:
        assert video.n_frames == 4
    assert main(["render", "--output", str(path)]) == 2
    assert "a POLICY or --controller NAME is needed" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["render", "ddpg"])
