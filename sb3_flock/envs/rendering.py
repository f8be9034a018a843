"""Drawing a flock with pygame: a window or a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_flock.sim import sense

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim import Scenario, World

try:
    import pygame
except ImportError as error:
    raise ImportError("rendering needs pygame: pip install 'sb3_flock[render]'") from error

_SIZE = 640
"""Side of the picture [pixels]."""
_MARGIN = 1.1
"""The picture shows this many times the arena; the vehicles may leave it."""

# Okabe and Ito's palette, told apart by the color-blind as well; shapes differ, too.
_BACKGROUND = (255, 255, 255)
_GRID = (225, 225, 225)
_LINK = (86, 180, 233)
_VEHICLE = (0, 114, 178)
_VIOLATION = (213, 94, 0)
_OBSTACLE = (204, 121, 167)
_WAYPOINT = (0, 0, 0)


class Renderer:
    """Draws the first flock of a world.

    Vehicles are arrowheads inside a circle of half their minimum separation (circles that overlap are too close, and turn
    orange); lines are links of the proximity graph; obstacles are discs inside a circle of their minimum separation; the
    waypoint is a cross.

    :param scenario: the task
    :param render_mode: ``"human"`` opens a window at the first drawing, ``"rgb_array"`` never does
    :param fps: pictures per second in the window
    """

    def __init__(self, scenario: Scenario, render_mode: str, fps: int) -> None:
        self.scenario, self.render_mode, self.fps = scenario, render_mode, fps
        self.canvas = pygame.Surface((_SIZE, _SIZE))
        self._window: pygame.Surface | None = None
        self._clock = pygame.time.Clock()
        half = _MARGIN * max(scenario.arena, scenario.obstacle_half_side)
        self._scale = _SIZE / (2 * half)

    def draw(self, world: World) -> NDArray[np.uint8] | None:
        """The picture, ``(height, width, 3)``, or ``None`` after showing it in the window."""
        self._paint(world)
        if self.render_mode == "human":
            self._show()
            return None
        return np.ascontiguousarray(pygame.surfarray.array3d(self.canvas).swapaxes(0, 1))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            pygame.display.quit()
            self._window = None

    def _show(self) -> None:
        if self._window is None:
            pygame.display.init()
            self._window = pygame.display.set_mode((_SIZE, _SIZE))
            pygame.display.set_caption("sb3_flock")
        pygame.event.pump()
        self._window.blit(self.canvas, (0, 0))
        pygame.display.flip()
        self._clock.tick(self.fps)

    def _paint(self, world: World) -> None:
        scenario, canvas = self.scenario, self.canvas
        canvas.fill(_BACKGROUND)
        corner = self._pixels(np.array([-scenario.arena, scenario.arena]))
        side = 2 * scenario.arena * self._scale
        pygame.draw.rect(canvas, _GRID, (*corner, side, side), width=2)

        sensing = sense(world)
        positions = world.positions[0]
        too_close = sensing.neighbors.count(scenario.neighbor_separation)[0] > 0
        hit = sensing.obstacles.count(scenario.obstacle_separation)[0] > 0
        for i, j in zip(sensing.neighbors.observers, sensing.neighbors.bodies, strict=True):
            if i < j:  # each link is seen from both ends
                pygame.draw.aaline(canvas, _LINK, self._pixels(positions[i]), self._pixels(positions[j]))
        for obstacle in world.obstacle_positions[0]:
            pygame.draw.circle(canvas, _OBSTACLE, self._pixels(obstacle), 5)
            radius = scenario.obstacle_separation * self._scale
            pygame.draw.circle(canvas, _OBSTACLE, self._pixels(obstacle), radius, width=1)
        self._cross(world.waypoints[0])
        for position, heading, violates in zip(positions, world.headings[0], too_close | hit, strict=True):
            color = _VIOLATION if violates else _VEHICLE
            self._arrowhead(position, heading, color)
            radius = 0.5 * scenario.neighbor_separation * self._scale
            pygame.draw.circle(canvas, color, self._pixels(position), radius, width=1)

    def _arrowhead(self, position: NDArray[np.float64], heading: float, color: tuple[int, int, int]) -> None:
        angles = heading + np.array([0.0, 2.5, np.pi, -2.5])
        reach = np.array([1.0, 0.8, 0.3, 0.8])[:, None] * 11 / self._scale
        corners = position + reach * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        pygame.draw.polygon(self.canvas, color, [self._pixels(corner) for corner in corners])

    def _cross(self, position: NDArray[np.float64]) -> None:
        x, y = self._pixels(position)
        pygame.draw.line(self.canvas, _WAYPOINT, (x - 7, y), (x + 7, y), width=3)
        pygame.draw.line(self.canvas, _WAYPOINT, (x, y - 7), (x, y + 7), width=3)

    def _pixels(self, point: NDArray[np.float64]) -> tuple[float, float]:
        """World meters, y up, to pixels, y down."""
        return _SIZE / 2 + float(point[0]) * self._scale, _SIZE / 2 - float(point[1]) * self._scale
