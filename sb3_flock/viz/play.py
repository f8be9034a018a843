"""An interactive window that simulates a flock live (``sb3-flock play``)."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.rollout import as_controller
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, observe
from sb3_flock.viz.video import check_speed

try:
    import pygame

    from sb3_flock.envs.rendering import HEADER, SIDE, Renderer
except ImportError:
    raise SettingsError("play needs pygame: pip install 'sb3_flock[render]'") from None

_PANEL = 224
"""Width of the panel beside the arena [pixels]."""
_TILE = 146
"""Side of a channel's image [pixels]."""
_GRAB_RADIUS = 14
"""Distance within which a press takes hold of the waypoint or an obstacle [pixels]."""
_MAX_CYCLES = 20_000
"""Length of an episode here; afterwards the obstacles repeat their walk."""
_HELP = (
    "drag the cross: waypoint",
    "click: drop or remove",
    "    an obstacle",
    "space: pause, dot: one step",
    "+ -: vehicles (+ at pointer)",
    "v: the next one's observation,",
    "    forward is up",
    "r: new episode",
    "q: quit",
)
_CHANNELS = ("neighbors", "obstacles", "waypoint")


class Game:
    """An episode that the user changes while it runs: the window's content and its events.

    :param policy: a controller, or anything with SB3's ``predict``
    :param scenario: the task; its episodes do not end here, and a key switches its safety filter off and on, ``announce`` if it
        has none
    :param seed: of the episodes
    :raises SettingsError: if pygame is not installed
    """

    world: World
    sensing: Sensing
    held: NDArray[np.float64] | None
    """Position to which the waypoint was dragged."""

    def __init__(self, policy: Any, scenario: Scenario, seed: int = 0) -> None:
        self.controller = as_controller(policy, scenario)
        self.renderer = Renderer(scenario, "rgb_array", fps=0)
        self.scenario = scenario.replace(max_cycles=max(_MAX_CYCLES, scenario.max_cycles))
        names = ("safety_filter", "obstacle_filter")
        self._filter = (
            {name: getattr(scenario, name) for name in names} if scenario.is_filtered else {"safety_filter": "announce"}
        )
        self._filter_error: str | None = None
        self.seed, self.episode = seed, 0
        self.is_paused = self.is_over = self.is_dragging = False
        self.watched: int | None = None
        self._font = pygame.font.Font(None, 19)
        self._keys: dict[int, Callable[[], None]] = {
            pygame.K_SPACE: self._pause,
            pygame.K_PERIOD: self.step,
            pygame.K_PLUS: self._add_vehicle,
            pygame.K_EQUALS: self._add_vehicle,  # plus without shift
            pygame.K_KP_PLUS: self._add_vehicle,
            pygame.K_MINUS: self._remove_vehicle,
            pygame.K_KP_MINUS: self._remove_vehicle,
            pygame.K_v: self._watch_next,
            pygame.K_f: self._switch_filter,
            pygame.K_r: self._next_episode,
            pygame.K_q: self._quit,
            pygame.K_ESCAPE: self._quit,
        }
        self._begin()

    @property
    def current_scenario(self) -> Scenario:
        """The task with the present number of bodies."""
        world = self.world.scenario
        return self.scenario.replace(n_vehicles=world.n_vehicles, n_obstacles=world.n_obstacles)

    @property
    def caption(self) -> str:
        """The window's title: the number of bodies and the state."""
        words = [self.world.scenario.bodies]
        words += [f"safety filter {self.filter_in_words}"] if self.scenario.is_filtered else []
        words += [f"vehicle {self.watched} is watched"] if self.watched is not None else []
        words += ["paused"] if self.is_paused else []
        return "sb3_flock: " + ", ".join(words)

    @property
    def filter_in_words(self) -> str:
        """Which safety filter is on: ``announce + obstacles``."""
        scenario = self.scenario
        levels = [scenario.safety_filter] if scenario.safety_filter != "off" else []
        return " + ".join(levels + ["obstacles"] * scenario.obstacle_filter) or "off"

    def step(self) -> None:
        """Simulate one step."""
        if self.world.steps == self.world.scenario.max_cycles:
            self._change(steps=0)
        self.sensing, _ = self.world.step(
            self.controller.act(self.world.sensors.measure(self.sensing), self.current_scenario)
        )
        self._hold_waypoint()

    def handle(self, event: pygame.event.Event) -> None:
        """Handle a key or mouse event."""
        if event.type == pygame.QUIT:
            self._quit()
        elif event.type == pygame.KEYDOWN:
            pressed = pygame.K_PLUS if event.unicode == "+" else event.key  # keyboard layouts differ
            self._keys.get(pressed, lambda: None)()
        elif event.type == pygame.MOUSEBUTTONDOWN and event.button == 1 and self._is_in_picture(event.pos):
            self._press(self.renderer.position_at(event.pos))
        elif event.type == pygame.MOUSEBUTTONUP and event.button == 1:
            self.is_dragging = False
        elif event.type == pygame.MOUSEMOTION and self.is_dragging and self._is_in_picture(event.pos):
            self.held = self.renderer.position_at(event.pos)
            self._hold_waypoint()

    def draw(self) -> pygame.Surface:
        """The window's content."""
        picture = pygame.Surface((SIDE + _PANEL, HEADER + SIDE))
        picture.fill("white")
        picture.blit(self.renderer.draw_surface(self.world), (0, 0))
        lines = (*_HELP, f"f: {self._filter_error or f'filter {self.filter_in_words}'}")
        for line, text in enumerate(lines):
            picture.blit(self._font.render(text, True, (60, 60, 60)), (SIDE, 12 + 18 * line))
        if self.watched is not None:
            self._draw_channels(picture, 12 + 18 * len(lines))
        return picture

    # -- what events do ----------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        self.rng = episode_rng(self.seed, self.episode)
        self.held = None
        self.world = World(self.scenario)
        self.sensing = self.world.reset([self.rng])
        self._reset_controller()

    def _next_episode(self) -> None:
        self.episode += 1
        self.watched = None
        self._begin()

    def _pause(self) -> None:
        self.is_paused = not self.is_paused

    def _quit(self) -> None:
        self.is_over = True

    def _switch_filter(self) -> None:
        off = {"safety_filter": "off", "obstacle_filter": False}
        try:
            self.scenario = self.scenario.replace(**(off if self.scenario.is_filtered else self._filter))
            self.world.scenario = self.current_scenario
        except SettingsError:
            self._filter_error = "ranges too short for a filter"

    def _watch_next(self) -> None:
        following = 0 if self.watched is None else self.watched + 1
        self.watched = following if following < self.world.scenario.n_vehicles else None

    def _press(self, place: NDArray[np.float64]) -> None:
        grab_radius = _GRAB_RADIUS * np.linalg.norm(self.renderer.position_at((1, 0)) - self.renderer.position_at((0, 0)))
        if np.linalg.norm(self.world.waypoints[0] - place) < grab_radius:
            self.is_dragging = True
            return
        near = np.flatnonzero(np.linalg.norm(self.world.obstacle_positions[0] - place, axis=-1) < grab_radius)
        if len(near):
            self._change(**{name: np.delete(values, near[0], axis) for name, values, axis in self._obstacles(self.world)})
        else:
            self._add_obstacle(place)

    def _add_obstacle(self, place: NDArray[np.float64]) -> None:
        other = World(self.scenario.replace(n_vehicles=1, n_obstacles=1))
        other.reset([self.rng])
        other.obstacle_positions[:] = place
        pairs = zip(self._obstacles(self.world), self._obstacles(other), strict=True)
        self._change(**{name: np.concatenate((ours, theirs), axis) for (name, ours, axis), (_, theirs, _) in pairs})

    def _add_vehicle(self) -> None:
        pointer = pygame.mouse.get_pos() if pygame.display.get_init() else (0, 0)
        place = self.renderer.position_at(pointer) if self._is_in_picture(pointer) else np.zeros(2)
        self._change(
            positions=np.concatenate((self.world.positions, place[None, None]), axis=1),
            headings=np.concatenate((self.world.headings, self.rng.uniform(-np.pi, np.pi, (1, 1))), axis=1),
        )

    def _remove_vehicle(self) -> None:
        if self.world.scenario.n_vehicles > 1:
            self._change(positions=self.world.positions[:, :-1], headings=self.world.headings[:, :-1])
            if self.watched == self.world.scenario.n_vehicles:
                self.watched = None

    @staticmethod
    def _obstacles(world: World) -> list[tuple[str, NDArray[np.float64], int]]:
        """A world's arrays of obstacles: name, values, and the axis along which the obstacles are."""
        state = world.state_dict()
        axes = {"obstacle_positions": 1, "obstacle_headings": 1, "obstacle_speeds": 2, "obstacle_turn_rates": 2}
        return [(name, state[name], axis) for name, axis in axes.items()]

    def _change(self, **values: Any) -> None:
        """Continue in a world with other bodies."""
        state = {**self.world.state_dict(), **values}
        n_vehicles, n_obstacles = (state[name].shape[1] for name in ("positions", "obstacle_positions"))
        self.world = World(self.scenario.replace(n_vehicles=n_vehicles, n_obstacles=n_obstacles))
        self.world.dynamics.reset([self.rng])
        starting = self.world.dynamics.state_dict()  # a vehicle that joins moves as at the start of an episode
        for name, present in state["dynamics"].items():
            if name != "rngs":
                joining = starting[name][:, present.shape[1] :]
                starting[name] = np.concatenate((present[:, :n_vehicles], joining), axis=1)
        self.world.load_state_dict({**state, "dynamics": {**starting, "rngs": state["dynamics"]["rngs"]}})
        self.world.sensors.forget()
        self.sensing = self.world.sense()
        self._reset_controller()

    def _reset_controller(self) -> None:
        self.controller.reset([self.rng], self.current_scenario)

    def _hold_waypoint(self) -> None:
        """Keep a dragged waypoint where it was left."""
        if self.held is not None:
            self.world.waypoints = self.held[None].copy()
            self.sensing = self.world.sense(self.sensing.ego_motion)

    @staticmethod
    def _is_in_picture(pixels: tuple[int, int]) -> bool:
        return 0 <= pixels[0] < SIDE and HEADER <= pixels[1] < HEADER + SIDE

    # -- what one vehicle observes ---------------------------------------------------------------------------------------

    def _draw_channels(self, picture: pygame.Surface, top: int) -> None:
        """The watched vehicle's observation, forward up and left to the left; and a ring around the vehicle."""
        assert self.watched is not None
        x, y = self.renderer.pixels_of(self.world.positions[0, self.watched])
        pygame.draw.circle(picture, "black", (x, y), 24, width=2)
        channels = observe(self.sensing, self.scenario)[0, self.watched, : len(_CHANNELS)]
        for channel, (values, name) in enumerate(zip(channels, _CHANNELS, strict=True)):
            grey = (255 * (1 - np.clip(values, 0, 1))).astype(np.uint8)
            # [forward, left] to pixels [x to the right, y downward]
            pixels = np.repeat(grey[::-1, ::-1].T[..., None], 3, axis=-1)
            tile = pygame.transform.scale(pygame.surfarray.make_surface(pixels), (_TILE, _TILE))
            corner = (SIDE + 16, top + 4 + channel * (_TILE + 20))
            picture.blit(tile, corner)
            pygame.draw.rect(picture, (160, 160, 160), (*corner, _TILE, _TILE), width=1)
            picture.blit(self._font.render(name, True, (60, 60, 60)), (corner[0], corner[1] + _TILE + 2))


def play(policy: Any, scenario: Scenario, seed: int = 0, speed: float = 2.0) -> None:
    """Open a window and simulate until it is closed.

    :param policy: a controller, or anything with SB3's ``predict``
    :param speed: times real time
    :raises SettingsError: without a display, without pygame, or for a speed that is not accepted
    """
    check_speed(speed)
    try:
        pygame.display.init()
        has_display = pygame.display.get_driver() not in {"dummy", "offscreen"} or "SDL_VIDEODRIVER" in os.environ
        if not has_display:
            raise pygame.error("there is none")
        pygame.display.set_caption("sb3_flock")
        window = pygame.display.set_mode((SIDE + _PANEL, HEADER + SIDE))
    except pygame.error as error:
        pygame.display.quit()
        raise SettingsError(f"play: no display to open a window on ({error}); a video needs none") from None
    try:
        game, clock = Game(policy, scenario, seed), pygame.time.Clock()
        due = 0.0  # steps to simulate
        while not game.is_over:
            for event in pygame.event.get():
                game.handle(event)
            due = 0.0 if game.is_paused else min(due + clock.get_time() / 1000 * speed / scenario.time_step, 10.0)
            for _ in range(int(due)):
                game.step()
            due %= 1
            pygame.display.set_caption(game.caption)
            window.blit(game.draw(), (0, 0))
            pygame.display.flip()
            clock.tick(30)
    finally:
        pygame.display.quit()
