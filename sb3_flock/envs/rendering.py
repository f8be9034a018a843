"""Drawing a flock with pygame: an image, or a window."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from sb3_flock.sim.sensing import is_connected, nearest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from sb3_flock.sim import Scenario, Sensing, World

try:
    import pygame
except ImportError as error:
    raise ImportError("rendering needs pygame: pip install 'sb3_flock[render]'") from error

SIDE = 640
"""Side of the arena's image [pixels]."""
HEADER = 64
"""Height of the two lines above it: the step's metrics and the legend [pixels]. Multiples of 16 suit video codecs."""
_MARGIN = 1.1
"""Width of the image [arenas]; the vehicles may leave the arena."""
_OVERSAMPLING = 2
"""Lines are drawn this many times larger and scaled down, which smooths them."""
_TRAIL, _WAYPOINT_PATH = 20, 400
"""Steps of a vehicle's trail and of the waypoint's path."""

# Okabe and Ito's palette, distinguishable by color-blind readers; shapes differ as well.
_BACKGROUND = (255, 255, 255)
_GRID = (225, 225, 225)
_TEXT = (60, 60, 60)
_LINK = (86, 180, 233)
_VEHICLE = (0, 114, 178)
_VIOLATION = (213, 94, 0)
_OBSTACLE = (204, 121, 167)
_WAYPOINT = (0, 0, 0)
PALETTE = (_BACKGROUND, _GRID, _TEXT, _LINK, _VEHICLE, _VIOLATION, _OBSTACLE, _WAYPOINT)

Color = tuple[int, int, int]
Pixels = tuple[float, float]


class Renderer:
    """Draws the first flock of a world.

    A vehicle is an arrowhead in a disc of half its minimum separation r_n' (overlapping discs are a violation) in a ring of its
    link range r_n, with its trail behind it; one that violates a separation is orange. Lines are links of the proximity
    graph, obstacles are squares in a ring of their minimum separation r_o', the waypoint is a cross with its path.

    :param scenario: the task
    :param render_mode: ``"human"`` opens a window at the first drawing, ``"rgb_array"`` never does
    :param fps: frames per second in the window
    """

    def __init__(self, scenario: Scenario, render_mode: str, fps: float) -> None:
        self.render_mode, self.fps = render_mode, fps
        self._window: pygame.Surface | None = None
        self._clock = pygame.time.Clock()
        self._arena = scenario.arena
        self._scale = SIDE * _OVERSAMPLING / (2 * _MARGIN * max(scenario.arena, scenario.obstacle_half_side))
        self._canvas = pygame.Surface((SIDE * _OVERSAMPLING, SIDE * _OVERSAMPLING))
        pygame.font.init()
        self._font = pygame.font.Font(None, 19)
        self._steps = -1
        self._trails: deque[NDArray[np.float64]] = deque(maxlen=_TRAIL)
        self._waypoints: deque[NDArray[np.float64]] = deque(maxlen=_WAYPOINT_PATH)

    def draw(self, world: World) -> NDArray[np.uint8] | None:
        """The image, ``(height, width, 3)``, or ``None`` after showing it in the window."""
        if self.render_mode == "human":
            self._show(self.draw_surface(world))
            return None
        return self.image(world)

    def image(self, world: World) -> NDArray[np.uint8]:
        """The image, ``(height, width, 3)``."""
        return np.ascontiguousarray(pygame.surfarray.array3d(self.draw_surface(world)).swapaxes(0, 1))

    def draw_surface(self, world: World) -> pygame.Surface:
        """The image as a surface of ``SIDE`` x ``HEADER + SIDE`` pixels."""
        self._keep_paths(world)
        sensing = world.sense()
        picture = pygame.Surface((SIDE, HEADER + SIDE))
        picture.fill(_BACKGROUND)
        self._draw_arena(world, sensing)
        picture.blit(pygame.transform.smoothscale(self._canvas, (SIDE, SIDE)), (0, HEADER))
        self._draw_metrics(picture, world, sensing)
        self._draw_legend(picture)
        return picture

    def position_at(self, pixels: Pixels) -> NDArray[np.float64]:
        """The position in the world [m] under a pixel of the image."""
        x, y = pixels[0] * _OVERSAMPLING, (pixels[1] - HEADER) * _OVERSAMPLING
        half = SIDE * _OVERSAMPLING / 2
        return np.array([x - half, half - y]) / self._scale

    def pixels_of(self, position: NDArray[np.float64]) -> Pixels:
        """The pixel of the image over a position in the world [m]."""
        x, y = self._pixels(position)
        return x / _OVERSAMPLING, y / _OVERSAMPLING + HEADER

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            pygame.display.quit()
            self._window = None

    def _show(self, picture: pygame.Surface) -> None:
        if self._window is None:
            pygame.display.init()
            self._window = pygame.display.set_mode(picture.get_size())
            pygame.display.set_caption("sb3_flock")
        pygame.event.pump()
        self._window.blit(picture, (0, 0))
        pygame.display.flip()
        self._clock.tick(self.fps)

    def _keep_paths(self, world: World) -> None:
        """Keep the paths since the start of the episode; they start anew when the number of vehicles changes."""
        if world.steps < self._steps or (self._trails and len(self._trails[-1]) != world.scenario.n_vehicles):
            self._trails.clear()
            self._waypoints.clear()
        if world.steps != self._steps or not self._trails:
            self._trails.append(world.positions[0].copy())
            self._waypoints.append(world.waypoints[0].copy())
        self._steps = world.steps

    # -- the arena, in oversampled pixels -----------------------------------------------------------------------------------

    def _draw_arena(self, world: World, sensing: Sensing) -> None:
        scenario, canvas = world.scenario, self._canvas
        canvas.fill(_BACKGROUND)
        side = 2 * self._arena * self._scale
        pygame.draw.rect(canvas, _GRID, (*self._pixels((-self._arena, self._arena)), side, side), width=2 * _OVERSAMPLING)

        positions, headings = world.positions[0], world.headings[0]
        close = sensing.neighbors.count(scenario.neighbor_separation) + sensing.obstacles.count(scenario.obstacle_separation)
        colors = [_VIOLATION if violates else _VEHICLE for violates in close[0]]
        disc, ring = (self._scale * reach for reach in (scenario.neighbor_separation / 2, scenario.link_range))
        for position in positions:
            pygame.draw.circle(canvas, _GRID, self._pixels(position), ring, width=_OVERSAMPLING)
        for position, color in zip(positions, colors, strict=True):
            pygame.draw.circle(canvas, _paler(color, 0.8), self._pixels(position), disc)
        self._path(self._waypoints, _paler(_WAYPOINT, 0.6), 2, dotted=True)
        for vehicle in range(len(positions)):
            self._path([trail[vehicle] for trail in self._trails], _paler(_VEHICLE, 0.5), 1)
        for i, j in zip(sensing.neighbors.observers, sensing.neighbors.bodies, strict=True):
            if i < j:  # each link is listed from both ends
                pygame.draw.line(
                    canvas, _LINK, self._pixels(positions[i]), self._pixels(positions[j]), width=2 * _OVERSAMPLING
                )
        for obstacle in world.obstacle_positions[0]:
            pygame.draw.circle(
                canvas,
                _OBSTACLE,
                self._pixels(obstacle),
                scenario.obstacle_separation * self._scale,
                width=2 * _OVERSAMPLING,
            )
            _square(canvas, self._pixels(obstacle), 6 * _OVERSAMPLING)
        _cross(canvas, self._pixels(world.waypoints[0]), 8 * _OVERSAMPLING)
        for position, heading, color in zip(positions, headings, colors, strict=True):
            _arrowhead(canvas, self._pixels(position), heading, max(7.0 * _OVERSAMPLING, 0.85 * disc), color)

    def _path(self, points: Iterable[NDArray[np.float64]], color: Color, width: int, dotted: bool = False) -> None:
        pixels = [self._pixels(point) for point in points]
        if dotted:
            for pixel in pixels[::2]:
                pygame.draw.circle(self._canvas, color, pixel, width)
        elif len(pixels) > 1:
            pygame.draw.lines(self._canvas, color, False, pixels, width * _OVERSAMPLING)

    def _pixels(self, point: Iterable[float]) -> Pixels:
        """World meters, y up, to oversampled pixels, y down."""
        x, y = point
        half = SIDE * _OVERSAMPLING / 2
        return half + float(x) * self._scale, half - float(y) * self._scale

    # -- the header --------------------------------------------------------------------------------------------------

    def _draw_metrics(self, picture: pygame.Surface, world: World, sensing: Sensing) -> None:
        scenario, positions = world.scenario, world.positions
        words = [
            (f"{world.steps * scenario.time_step:.1f} s", False),
            (f"tracking error {sensing.waypoint_distances.mean():#.3g} m", False),
        ]
        bodies = (
            ("nearest neighbor", nearest(positions, positions, exclude_self=True), scenario.neighbor_separation),
            ("obstacle", nearest(positions, world.obstacle_positions), scenario.obstacle_separation),
        )
        for name, distances, separation in bodies:
            least = distances.min()
            if np.isfinite(least):
                words.append((f"{name} {least:#.3g} m", bool(least < separation)))
        words.append(("connected" if is_connected(sensing.neighbors)[0] else "not connected", False))
        x = 12
        for word, is_bad in words:
            text = self._font.render(word, True, _VIOLATION if is_bad else _TEXT)
            picture.blit(text, (x, 10))
            x += text.get_width() + 14

    def _draw_legend(self, picture: pygame.Surface) -> None:
        canvas = pygame.Surface((SIDE * _OVERSAMPLING, HEADER * _OVERSAMPLING // 2))
        canvas.fill(_BACKGROUND)
        y, words = canvas.get_height() / 2, []
        x = 20.0 * _OVERSAMPLING

        def name(word: str, *, after: float) -> None:
            nonlocal x
            words.append((word, x / _OVERSAMPLING + after))
            x += (after + self._font.size(word)[0] + 26) * _OVERSAMPLING

        pygame.draw.circle(canvas, _paler(_VEHICLE, 0.8), (x, y), 9 * _OVERSAMPLING)
        _arrowhead(canvas, (x, y), np.pi / 2, 8 * _OVERSAMPLING, _VEHICLE)
        name("vehicle, r_n' / 2", after=14)
        pygame.draw.circle(canvas, _paler(_GRID, -0.25), (x, y), 9 * _OVERSAMPLING, width=_OVERSAMPLING)
        name("r_n", after=14)
        pygame.draw.line(canvas, _LINK, (x - 9 * _OVERSAMPLING, y), (x + 9 * _OVERSAMPLING, y), width=2 * _OVERSAMPLING)
        name("link", after=14)
        _arrowhead(canvas, (x, y), np.pi / 2, 8 * _OVERSAMPLING, _VIOLATION)
        name("violation", after=12)
        pygame.draw.circle(canvas, _OBSTACLE, (x, y), 9 * _OVERSAMPLING, width=2 * _OVERSAMPLING)
        _square(canvas, (x, y), 5 * _OVERSAMPLING)
        name("obstacle, r_o'", after=14)
        _cross(canvas, (x, y), 7 * _OVERSAMPLING)
        name("waypoint", after=12)
        picture.blit(pygame.transform.smoothscale(canvas, (SIDE, HEADER // 2)), (0, HEADER // 2))
        for word, left in words:
            text = self._font.render(word, True, _TEXT)
            picture.blit(text, (left, HEADER // 2 + (HEADER // 2 - text.get_height()) / 2 + 1))


def _arrowhead(canvas: pygame.Surface, center: Pixels, heading: float, size: float, color: Color) -> None:
    angles = heading + np.array([0.0, 2.5, np.pi, -2.5])
    reach = np.array([1.0, 0.8, 0.3, 0.8]) * size
    corners = np.stack((center[0] + reach * np.cos(angles), center[1] - reach * np.sin(angles)), axis=-1)
    pygame.draw.polygon(canvas, color, corners.tolist())


def _cross(canvas: pygame.Surface, center: Pixels, size: float) -> None:
    x, y = center
    pygame.draw.line(canvas, _WAYPOINT, (x - size, y), (x + size, y), width=3 * _OVERSAMPLING)
    pygame.draw.line(canvas, _WAYPOINT, (x, y - size), (x, y + size), width=3 * _OVERSAMPLING)


def _square(canvas: pygame.Surface, center: Pixels, half: float) -> None:
    pygame.draw.rect(canvas, _OBSTACLE, (center[0] - half, center[1] - half, 2 * half, 2 * half))


def _paler(color: Color, share: float) -> Color:
    """A color mixed with so much white; with black for a negative share."""
    target = 255 if share > 0 else 0
    red, green, blue = (round(value + abs(share) * (target - value)) for value in color)
    return red, green, blue
