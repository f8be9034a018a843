"""Films of a flight: GIF, MP4, or a web page that plays in any browser, offline."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.episodes import fly_one
from sb3_flock.evaluation.figures import FIGURES, check_figure_file, record, save_as, trajectories
from sb3_flock.rl.saving import write_whole
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario

Picture = NDArray[np.uint8]

_MOST_FPS = 50
"""Pictures per second at most; steps are left out beyond. A GIF shows no more."""
_COLORS = 64
"""Colors of a GIF, chosen once from pictures all over the flight."""


def render(
    policy: Any,
    scenario: Scenario,
    path: str | Path,
    seed: int = 0,
    episode: int = 0,
    speed: float = 2.0,
    title: str = "sb3_flock",
) -> Path:
    """Fly one episode and write it as the file's name asks: ``.gif``, ``.mp4`` and ``.html`` move, ``.png`` and ``.svg`` are
    the paper's figure of trajectories.

    :param policy: a controller, or anything with SB3's ``predict``
    :param path: the file; a web page holds everything in itself and is played by the browser's own player
    :param seed: the episode is the one that :func:`~sb3_flock.evaluation.evaluate` flies under this seed and number
    :param speed: times real time
    :param title: of the web page
    :return: the path
    :raises SettingsError: for another kind of file, a folder that is not there, or a missing library
    :raises OSError: if the file cannot be written; what was there before stays
    """
    path = Path(path)
    check_film(path, speed)
    with write_whole(path) as aside:
        if path.suffix in FIGURES:
            save_as(trajectories(record(policy, scenario, seed, episode)), aside, path.suffix[1:])
            return path
        step = scenario.time_step / speed
        stride = math.ceil(1 / (_MOST_FPS * step))
        pictures = _pictures(policy, scenario, seed, episode, stride)
        FILMS[path.suffix](aside, pictures, 1 / (stride * step), title)
    return path


def check_film(path: Path, speed: float) -> None:
    """Tell what is wrong with a file's name or a missing library before the flight, not after it.

    :raises SettingsError: one line
    """
    check_figure_file(path, (*FILMS, *FIGURES))
    check_speed(speed)
    if path.suffix in FIGURES:
        return
    try:
        import imageio_ffmpeg  # noqa: F401
        import PIL  # noqa: F401
        import pygame  # noqa: F401
    except ImportError as error:
        raise SettingsError(f"--out {path}: {error.name} is needed: pip install 'sb3_flock[render]'") from None


def check_speed(speed: float) -> None:
    """Whether a speed is accepted.

    :raises SettingsError: if not
    """
    if not 0.01 <= speed <= 1000:
        raise SettingsError(f"--speed {speed:g}: from 0.01 to 1000 times real time is needed")


def _pictures(policy: Any, scenario: Scenario, seed: int, episode: int, stride: int) -> Iterator[Picture]:
    from sb3_flock.envs.rendering import Renderer

    renderer = Renderer(scenario, "rgb_array", fps=0)
    for world in fly_one(policy, scenario, seed, episode):
        picture = renderer.picture(world)  # every step leaves its trail
        if world.steps % stride == 0:
            yield picture


def _write_gif(path: Path, pictures: Iterator[Picture], fps: float, title: str) -> None:
    from PIL import Image

    from sb3_flock.envs.rendering import PALETTE

    frames = [Image.fromarray(picture) for picture in pictures]
    some = frames[:: max(1, len(frames) // 8)]
    width, height = some[0].size
    together = Image.new("RGB", (width, height * (len(some) + 1)))
    for place, frame in enumerate(some):
        together.paste(frame, (0, place * height))
    band = height // len(PALETTE)
    for place, color in enumerate(PALETTE):  # colors that are seldom there are kept as well
        together.paste(color, (0, height * len(some) + place * band, width, height * len(some) + (place + 1) * band))
    palette = together.quantize(_COLORS, dither=Image.Dither.NONE)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first.save(path, "GIF", save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def _write_mp4(path: Path, pictures: Iterator[Picture], fps: float, title: str) -> None:
    _encode(path, pictures, fps, "mp4", "libx264", ["-crf", "20", "-movflags", "+faststart"])


def _write_page(path: Path, pictures: Iterator[Picture], fps: float, title: str) -> None:
    """A page without a script: the player is the browser's own. Every browser plays VP9, whoever built it."""
    film = path.with_name(f"{path.name}.webm")
    try:
        _encode(
            film, pictures, fps, "webm", "libvpx-vp9", ["-crf", "30", "-b:v", "0", "-g", str(round(fps)), "-cpu-used", "4"]
        )
        data = base64.b64encode(film.read_bytes()).decode("ascii")
    finally:
        film.unlink(missing_ok=True)
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


def _encode(path: Path, pictures: Iterator[Picture], fps: float, container: str, codec: str, options: list[str]) -> None:
    """Through imageio-ffmpeg, which carries its own ffmpeg."""
    import imageio_ffmpeg

    (first,) = islice(pictures, 1)
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
        for picture in pictures:
            writer.send(picture)
    finally:
        writer.close()


FILMS: dict[str, Callable[[Path, Iterator[Picture], float, str], None]] = {
    ".gif": _write_gif,
    ".mp4": _write_mp4,
    ".html": _write_page,
}
"""What moves, by the end of the file's name."""
