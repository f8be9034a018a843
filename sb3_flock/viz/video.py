"""Videos of an episode: GIF, MP4, or a web page that plays in any browser, offline."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.rollout import iter_rollout
from sb3_flock.serialization.save import atomic_write
from sb3_flock.settings import SettingsError, suggest
from sb3_flock.sim import Scenario, World
from sb3_flock.sim.simulators import SIMULATORS, SimulatorDynamics
from sb3_flock.viz.figures import FIGURES, check_figure_file, plot_trajectories, record_trajectory, save_as

Frame = NDArray[np.uint8]

_MAX_FPS = 50
"""Largest frame rate; at higher speeds steps are left out. A GIF shows no more."""
VIEWS = ("plan", "simulator")
"""What a video may show: the flock from above, or the simulator's own pictures."""
_COLORS = 64
"""Colors of a GIF, chosen once from frames of the whole episode."""


def render(
    policy: Any,
    scenario: Scenario,
    path: str | Path,
    seed: int = 0,
    episode: int = 0,
    speed: float = 2.0,
    title: str = "sb3_flock",
    view: str = "plan",
) -> Path:
    """Simulate one episode and write it in the format of the file's ending: ``.gif``, ``.mp4`` and ``.html`` are
    videos, ``.png`` and ``.svg`` the paper's figure of trajectories.

    :param policy: a controller, or anything with SB3's ``predict``
    :param path: the file; a web page is self-contained and uses the browser's own video player
    :param seed: seed and number of the episode are those of :func:`~sb3_flock.evaluation.evaluate`
    :param speed: times real time
    :param title: of the web page
    :param view: of a video: ``plan``, from above, or ``simulator``, as the simulator of ``scenario.dynamics`` shows it
    :return: the path
    :raises SettingsError: for another view or kind of file, a folder that is not there, or a missing library
    :raises OSError: if the file cannot be written; an earlier file of that name stays
    """
    path = Path(path)
    check_video(path, speed)
    check_view(view, path, scenario)
    with atomic_write(path) as temporary:
        if path.suffix in FIGURES:
            save_as(plot_trajectories(record_trajectory(policy, scenario, seed, episode)), temporary, path.suffix[1:])
            return path
        step = scenario.time_step / speed
        stride = math.ceil(1 / (_MAX_FPS * step))
        frames = _frames(policy, scenario, seed, episode, stride, view)
        VIDEO_WRITERS[path.suffix](temporary, frames, 1 / (stride * step), title)
    return path


def check_video(path: Path, speed: float) -> None:
    """Check a file's name, the speed and the libraries before the simulation.

    :raises SettingsError: one line
    """
    check_figure_file(path, (*VIDEO_WRITERS, *FIGURES))
    check_speed(speed)
    if path.suffix in FIGURES:
        return
    try:
        import imageio_ffmpeg  # noqa: F401
        import PIL  # noqa: F401
        import pygame  # noqa: F401
    except ImportError as error:
        raise SettingsError(f"{path}: {error.name} is needed: pip install 'sb3_flock[render]'") from None


def check_speed(speed: float) -> None:
    """Check a playback speed.

    :raises SettingsError: if it is not accepted
    """
    if not 0.01 <= speed <= 1000:
        raise SettingsError(f"speed = {speed:g}: from 0.01 to 1000 times real time is needed")


def check_view(view: str, path: Path, scenario: Scenario) -> None:
    """Check the view of a video.

    :raises SettingsError: if it is not accepted
    """
    if view not in VIEWS:
        raise SettingsError(f"view = {view}: one of {', '.join(VIEWS)} is needed{suggest(view, VIEWS)}")
    if view == "simulator" and scenario.dynamics not in SIMULATORS:
        raise SettingsError(f"view = simulator: the dynamics are {scenario.dynamics}; a simulator is needed")
    if view == "simulator" and path.suffix in FIGURES:
        raise SettingsError(f"view = simulator: {path} shows paths; one of {', '.join(VIDEO_WRITERS)} is needed")


def _frames(policy: Any, scenario: Scenario, seed: int, episode: int, stride: int, view: str) -> Iterator[Frame]:
    def image_of(world: World) -> Frame:
        poses = np.concatenate((world.positions, world.headings[..., None]), axis=-1)
        return cast(SimulatorDynamics, world.dynamics).image(poses, world.obstacle_positions[0], world.waypoints[0])

    if view == "plan":
        from sb3_flock.envs.rendering import Renderer

        image_of = Renderer(scenario, "rgb_array", fps=0).image
    for world in iter_rollout(policy, scenario, seed, episode):
        frame = image_of(world)  # every step extends the trails
        if world.steps % stride == 0:
            yield frame


def _write_gif(path: Path, frames: Iterator[Frame], fps: float, title: str) -> None:
    from PIL import Image

    from sb3_flock.envs.rendering import PALETTE

    images = [Image.fromarray(frame) for frame in frames]
    some = images[:: max(1, len(images) // 8)]
    width, height = some[0].size
    together = Image.new("RGB", (width, height * (len(some) + 1)))
    for place, image in enumerate(some):
        together.paste(image, (0, place * height))
    band = height // len(PALETTE)
    for place, color in enumerate(PALETTE):  # rare colors stay in the palette
        together.paste(color, (0, height * len(some) + place * band, width, height * len(some) + (place + 1) * band))
    palette = together.quantize(_COLORS, dither=Image.Dither.NONE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(path, "GIF", save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def _write_mp4(path: Path, frames: Iterator[Frame], fps: float, title: str) -> None:
    _encode(path, frames, fps, "mp4", "libx264", ["-crf", "20", "-movflags", "+faststart"])


def _write_page(path: Path, frames: Iterator[Frame], fps: float, title: str) -> None:
    """A page without a script: the player is the browser's own. Every browser plays VP9."""
    video = path.with_name(f"{path.name}.webm")
    try:
        _encode(
            video, frames, fps, "webm", "libvpx-vp9", ["-crf", "30", "-b:v", "0", "-g", str(round(fps)), "-cpu-used", "4"]
        )
        data = base64.b64encode(video.read_bytes()).decode("ascii")
    finally:
        video.unlink(missing_ok=True)
    name = html.escape(title)
    path.write_text(_PAGE.format(title=name, data=data), encoding="utf-8")


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>
body {{ margin: 0 auto; max-width: 40rem; padding: 1rem; font-family: sans-serif; color: #333 }}
h1 {{ font-size: 1rem; font-weight: normal }}
video {{ width: 100% }}
</style>
</head>
<body>
<h1>{title}</h1>
<video controls autoplay loop muted playsinline src="data:video/webm;base64,{data}"></video>
</body>
</html>
"""


def _encode(path: Path, frames: Iterator[Frame], fps: float, container: str, codec: str, options: list[str]) -> None:
    """Through imageio-ffmpeg, which carries its own ffmpeg."""
    import imageio_ffmpeg

    (first,) = islice(frames, 1)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        first.shape[1::-1],
        fps=fps,
        codec=codec,
        quality=None,
        output_params=["-f", container, *options],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    try:
        writer.send(first)
        for frame in frames:
            writer.send(frame)
    finally:
        writer.close()


VIDEO_WRITERS: dict[str, Callable[[Path, Iterator[Frame], float, str], None]] = {
    ".gif": _write_gif,
    ".mp4": _write_mp4,
    ".html": _write_page,
}
"""Writers of videos by file name ending."""
