"""Pictures of a flock by MuJoCo's own renderer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flock.settings import RunError, first_line

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.sensing import SensingSettings

HEIGHT, WIDTH = 384, 512
"""Of the pictures [pixels]: multiples of 16 suit video codecs, and MuJoCo's buffer has 480 x 640."""
_ELEVATION, _AZIMUTH = -40.0, 90.0
"""The camera looks down by so much, along the y axis [degrees]."""
_MARGIN = 2.2
"""Distance of the camera [diameters of the flock], and at least of a flock of one meter."""
_OBSTACLE, _LINK, _WAYPOINT = (0.8, 0.47, 0.65, 1.0), (0.34, 0.71, 0.91, 1.0), (0.0, 0.0, 0.0, 1.0)


class View:
    """A camera that follows the flock, and what MuJoCo does not simulate: obstacles, the waypoint and links.

    An obstacle is a pillar in a disc of its minimum separation r_o', the waypoint is a black pole, and lines on the floor
    are links of the proximity graph.

    :param mujoco: the module
    :param model: the ``MjModel`` of the flock
    :param ranges: of links, and the obstacles' minimum separation
    :raises RunError: where MuJoCo finds no OpenGL
    """

    def __init__(self, mujoco: Any, model: Any, ranges: SensingSettings) -> None:
        self._mujoco, self._model, self._ranges = mujoco, model, ranges
        try:
            self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        except Exception as error:  # of the library that MUJOCO_GL names, each has its own
            raise RunError(
                f"view = simulator: MuJoCo cannot draw ({first_line(error)}); without a screen the environment variable "
                "MUJOCO_GL=egl or MUJOCO_GL=osmesa is needed"
            ) from None
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = _AZIMUTH, _ELEVATION

    def image(
        self, state: Any, positions: NDArray[np.float64], obstacles: NDArray[np.float64], waypoint: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """A flock, ``(HEIGHT, WIDTH, 3)``.

        :param state: the ``MjData`` of the flock
        :param positions: of its vehicles, ``(vehicles, 2)`` [m]
        :param obstacles: ``(obstacles, 2)`` [m]
        :param waypoint: ``(2,)`` [m]
        """
        kinds = self._mujoco.mjtGeom
        middle = positions.mean(axis=0)
        self._camera.lookat = (*middle, 0.0)
        self._camera.distance = _MARGIN * max(0.5, 2 * np.linalg.norm(positions - middle, axis=1).max())
        for compute in (self._mujoco.mj_kinematics, self._mujoco.mj_camlight):
            compute(self._model, state)  # for bodies that were placed and did not move yet
        self._renderer.update_scene(state, self._camera)
        for x, y in obstacles:
            self._add(kinds.mjGEOM_CYLINDER, (0.03, 0.05, 0), (x, y, 0.05), _OBSTACLE)
            self._add(
                kinds.mjGEOM_CYLINDER, (self._ranges.obstacle_separation, 0.001, 0), (x, y, 0.001), (*_OBSTACLE[:3], 0.3)
            )
        self._add(kinds.mjGEOM_CYLINDER, (0.006, 0.08, 0), (*waypoint, 0.08), _WAYPOINT)
        near = np.linalg.norm(positions[:, None] - positions, axis=-1) < self._ranges.link_range
        for i, j in np.argwhere(np.triu(near, 1)):
            line = self._add(kinds.mjGEOM_CAPSULE, np.zeros(3), np.zeros(3), _LINK)
            ends = ((*positions[k], 0.003) for k in (i, j))
            self._mujoco.mjv_connector(line, kinds.mjGEOM_CAPSULE, 0.003, *map(np.array, ends))
        return np.array(self._renderer.render())

    def _add(self, kind: Any, size: Any, position: Any, color: tuple[float, ...]) -> Any:
        """A body of the picture alone."""
        scene = self._renderer.scene
        body = scene.geoms[scene.ngeom]
        vectors = (np.array(size, float), np.array(position, float), np.eye(3).ravel(), np.array(color, np.float32))
        self._mujoco.mjv_initGeom(body, kind, *vectors)
        scene.ngeom += 1
        return body
