"""Images of a flock: agents, the leader in red, target velocities as blue arrows, communication edges in yellow.

An image depends on the state alone, not on the physics engine. PyBullet draws the solid parts with its software
renderer or in its window. The software renderer has no lines, antialiasing or transparency, so it draws at twice the
size, and edges are drawn over its image where the depth buffer has nothing nearer.
"""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.envs.flocking.rendering.meshes import ARROW, QUADCOPTER, normals, quaternions_along
from modgnn_rl.errors import InputError
from modgnn_rl.visualization.recording import Frame, shortest_edges

__all__ = ["RENDER_MODES", "Renderer", "check_render_mode", "has_display"]

Array = NDArray[Any]

RENDER_MODES = ("human", "rgb_array")
ARROW_TIME = 1.0  # s; the length of an arrow is the distance covered in this time
ARM = (0.11, 0.025)  # m, and fraction of the view: drawn length of agents' arms, exaggerated so that they are visible
LEADER_SCALE = 1.3
MAX_EDGES = 10_000  # the shortest are drawn
VIEW = np.array([-0.45, -0.85, 0.38])  # from the flock to the camera
FIELD_OF_VIEW = 30.0  # vertical, degrees
MIN_VIEW = 1.0  # m from the centre to the border
OVERSAMPLING = 2
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])  # quaternion
BACKGROUND = np.array([[251, 252, 254], [229, 234, 241]])  # top and bottom
WINDOW_BACKGROUND = " ".join(f"--background_color_{name}=0.95" for name in ("red", "green", "blue"))
HAZE = 0.4  # fraction of the background in the colour of the farthest parts
MESHES = {
    "follower": (QUADCOPTER, (0.12, 0.15, 0.22)),
    "leader": (LEADER_SCALE * QUADCOPTER, (0.86, 0.08, 0.10)),
    "arrow": (ARROW, (0.10, 0.38, 0.90)),
}
EDGE_COLOUR = (0.96, 0.74, 0.05)
EDGE_OPACITY = 0.5


class _Agents(NamedTuple):
    """The agents of a frame that are drawn: positions [N, 3], quaternions [N, 4], target velocities [N, 3]."""

    position: Array
    quaternion: Array
    target_velocity: Array


class Shape(NamedTuple):
    """Appearance of a body: a mesh of `MESHES`, its width and its length along its z axis, m."""

    mesh: str
    width: float
    length: float


class Camera(NamedTuple):
    """Viewpoint of an image: PyBullet's view and projection matrices, in its format."""

    target: Array
    distance: float
    view: tuple[float, ...]
    projection: tuple[float, ...]

    def project(self, points: Array, width: int, height: int) -> Array:
        """Project points [P, 3] to column, row, and depth as in PyBullet's depth buffer [P, 3]."""
        view, projection = (np.reshape(matrix, (4, 4)).T for matrix in (self.view, self.projection))
        clip = np.append(points, np.ones((len(points), 1)), -1) @ (projection @ view).T
        x, y, depth = (clip[:, :3] / clip[:, 3:]).T
        return np.stack(((1 + x) / 2 * width, (1 - y) / 2 * height, (1 + depth) / 2), -1)


class Renderer:
    """Draws flocks into arrays or into a window, with its own PyBullet client.

    Args:
        render_mode: ``"rgb_array"`` draws without a display, ``"human"`` in PyBullet's window.
        width: width of the image, pixels.
        height: height of the image, pixels.

    Raises:
        InputError: another mode or size is given, or there is no display for a window.
    """

    def __init__(self, render_mode: str = "rgb_array", width: int = 960, height: int = 720) -> None:
        check_render_mode(render_mode)
        for name, size in (("width", width), ("height", height)):
            if not isinstance(size, int) or not 16 <= size <= 4096:
                raise InputError(f"{name}={size!r} of the image is not an integer from 16 to 4096")
        from modgnn_rl.envs.flocking.physics.bullet import import_pybullet  # here, because it is slow to load

        pybullet = import_pybullet()
        self.bullet = pybullet
        self.render_mode, self.width, self.height = render_mode, width, height
        # PyBullet never frees the memory of a shape, so each is created once, and bodies of the same shape are moved.
        self.shapes: dict[Shape, int] = {}
        self.bodies: dict[tuple[str, int], tuple[Shape, int]] = {}
        self.lines: list[int] = []
        if render_mode == "rgb_array":
            self.client = pybullet.connect(pybullet.DIRECT)
            return
        try:
            options = f"--width={width} --height={height} {WINDOW_BACKGROUND}"
            self.client = pybullet.connect(pybullet.GUI, options=options)
        except pybullet.error as error:
            raise InputError(f"PyBullet could not open a window ({error}); close the other one first") from error
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=self.client)
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_SHADOWS, 0, physicsClientId=self.client)

    def draw(self, frame: Frame) -> Array | None:
        """Draw a flock; agents with a position that is NaN or infinite are left out.

        Returns:
            the image, uint8 [H, W, 3]; None for a window.

        Raises:
            InputError: the window has been closed.
        """
        if not self.bullet.isConnected(self.client):
            raise InputError("cannot draw: the window or the environment has been closed")
        edges = np.asarray(frame.position, np.float64)[shortest_edges(frame, MAX_EDGES)]
        drawn: Array = np.asarray(np.isfinite(frame.position).all(-1))
        quaternion = np.tile(LEVEL, (len(drawn), 1)) if frame.quaternion is None else frame.quaternion
        agents = _Agents(*(np.asarray(part, np.float64)[drawn] for part in (frame.position, quaternion, frame.arrow)))
        camera = self._camera(agents)
        if self.render_mode == "human":
            self._show(agents, camera, edges)
            return None
        return self._image(agents, camera, edges)

    def close(self) -> None:
        """Close the window and end the client."""
        if self.bullet.isConnected(self.client):
            self.bullet.disconnect(self.client)

    def _camera(self, agents: _Agents) -> Camera:
        """A camera with all agents and arrows in view."""
        points = np.concatenate((agents.position, agents.position + ARROW_TIME * agents.target_velocity))
        points = points if len(points) else np.zeros((1, 3))
        back = VIEW / np.linalg.norm(VIEW)
        right = np.cross((0, 0, 1), back)
        axes = np.stack((right / np.linalg.norm(right), np.cross(back, right / np.linalg.norm(right)), back))
        seen = points @ axes.T
        centre = (seen.min(0) + seen.max(0)) / 2
        slope = np.tan(np.radians(FIELD_OF_VIEW / 2)) * np.array((self.width / self.height, 1.0))
        offset = seen - centre
        fitting = (np.abs(offset[:, :2]) + ARM[0]) / slope + offset[:, 2:]
        distance = 1.05 * max(fitting.max(), MIN_VIEW / slope[1])
        depth = np.abs(offset[:, 2]).max() + 1.0
        target = centre @ axes
        view = self.bullet.computeViewMatrix(target + distance * back, target, (0, 0, 1))
        near, far = max(distance - depth, distance / 100), distance + depth
        aspect = self.width / self.height
        return Camera(target, distance, view, self.bullet.computeProjectionMatrixFOV(FIELD_OF_VIEW, aspect, near, far))

    def _place_bodies(self, agents: _Agents, camera: Camera) -> None:
        """Create or move the bodies of agents and arrows, and remove those no longer needed."""
        arm = round(max(ARM[0], ARM[1] * camera.distance * np.tan(np.radians(FIELD_OF_VIEW / 2))), 2)
        lengths = (ARROW_TIME * np.linalg.norm(agents.target_velocity, axis=-1)).round(2).tolist()
        directions = quaternions_along(agents.target_velocity)
        unused = set(self.bodies)
        for index, length in enumerate(lengths):
            parts = [("agent", Shape("follower" if index else "leader", arm, arm), agents.quaternion[index])]
            if length:
                parts.append(("arrow", Shape("arrow", round(0.18 * arm, 3), length), directions[index]))
            for name, shape, quaternion in parts:
                self._place((name, index), shape, agents.position[index], quaternion)
                unused.discard((name, index))
        for key in unused:
            self.bullet.removeBody(self.bodies.pop(key)[1], physicsClientId=self.client)

    def _place(self, key: tuple[str, int], shape: Shape, position: Array, quaternion: Array) -> None:
        """Move the body with this key if it has this shape, else replace it by a new one."""
        bullet, client = self.bullet, self.client
        old, body = self.bodies.get(key, (None, -1))
        if old == shape:
            bullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
            return
        if old is not None:
            bullet.removeBody(body, physicsClientId=client)
        body = bullet.createMultiBody(0, -1, self._visual_shape(shape), position, quaternion, physicsClientId=client)
        self.bodies[key] = (shape, body)

    def _visual_shape(self, shape: Shape) -> int:
        """PyBullet's index of a shape."""
        if shape not in self.shapes:
            mesh, colour = MESHES[shape.mesh]
            mesh = mesh * (shape.width, shape.width, shape.length)
            self.shapes[shape] = self.bullet.createVisualShape(
                self.bullet.GEOM_MESH,
                vertices=mesh.reshape(-1, 3).tolist(),
                indices=list(range(3 * len(mesh))),
                normals=normals(mesh).reshape(-1, 3).tolist(),
                rgbaColor=(*colour, 1.0),
                physicsClientId=self.client,
            )
        return self.shapes[shape]

    def _image(self, agents: _Agents, camera: Camera, edges: Array) -> Array:
        """The image, uint8 [H, W, 3]."""
        bullet, width, height = self.bullet, OVERSAMPLING * self.width, OVERSAMPLING * self.height
        self._place_bodies(agents, camera)
        _, _, colours, depth, bodies = bullet.getCameraImage(
            width,
            height,
            camera.view,
            camera.projection,
            lightDirection=(-0.6, -1.0, 2.0),
            lightAmbientCoeff=0.65,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.05,
            shadow=0,
            renderer=bullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        fine = np.linspace(BACKGROUND[0], BACKGROUND[1], height).astype(np.float32)[:, None].repeat(width, 1)
        depth = np.reshape(depth, (height, width))
        solid = np.reshape(bodies, (height, width)) >= 0
        fine[solid] += (np.reshape(colours, (height, width, 4))[solid][:, :3] - fine[solid]) * _opacity(depth[solid])
        _overlay(fine, depth, camera.project(edges.reshape(-1, 3), width, height).reshape(-1, 2, 3))
        offsets = range(OVERSAMPLING)
        parts = [fine[row::OVERSAMPLING, column::OVERSAMPLING] for row in offsets for column in offsets]
        image: Array = sum(parts[1:], parts[0]) / len(parts)
        return image.round().astype(np.uint8)

    def _show(self, agents: _Agents, camera: Camera, edges: Array) -> None:
        """Draw in the window, edges as debug lines."""
        bullet, client = self.bullet, self.client
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 0, physicsClientId=client)
        is_new = not self.bodies
        self._place_bodies(agents, camera)
        old, self.lines = self.lines, []
        for index, (begin, end) in enumerate(edges.tolist()):
            replaced = old[index] if index < len(old) else -1
            line = bullet.addUserDebugLine(
                begin, end, EDGE_COLOUR, replaceItemUniqueId=replaced, physicsClientId=client
            )
            self.lines.append(line)
        for line in old[len(edges) :]:
            bullet.removeUserDebugItem(line, physicsClientId=client)
        # The window follows the flock; direction and distance are set with the mouse.
        yaw, pitch, distance = bullet.getDebugVisualizerCamera(physicsClientId=client)[8:11]
        if is_new:
            yaw = np.degrees(np.arctan2(VIEW[1], VIEW[0])) + 90
            pitch = -np.degrees(np.arcsin(VIEW[2] / np.linalg.norm(VIEW)))
            distance = 0.4 * camera.distance  # its field of view is wider
        bullet.resetDebugVisualizerCamera(distance, yaw, pitch, camera.target, physicsClientId=client)
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 1, physicsClientId=client)


def has_display() -> bool:
    """Whether there is a display for a window; on Linux, an X server that answers."""
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:  # without this check, PyBullet would end the process
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)


def check_render_mode(render_mode: str | None) -> None:
    """Check that images can be drawn in this mode.

    Raises:
        InputError: the mode does not exist, or there is no display for a window.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise InputError(f"render_mode={render_mode!r} is not one of {', '.join(RENDER_MODES)}")
    if render_mode == "human" and not has_display():
        raise InputError('render_mode="human" needs a display and there is none; use render_mode="rgb_array"')


def _opacity(depth: Array) -> Array:
    """Opacity of solid parts in front of the background, by depth [P] -> [P, 1]; the nearest are opaque."""
    if not len(depth):
        return depth[:, None]
    nearest, farthest = depth.min(), depth.max()
    return 1 - HAZE * ((depth - nearest) / max(farthest - nearest, 1e-9))[:, None]


def _overlay(image: Array, depth: Array, lines: Array) -> None:
    """Draw lines over an image [H, W, 3] where nothing in the depth buffer [H, W] is nearer.

    Args:
        image: changed in place.
        depth: in PyBullet's format.
        lines: column, row and depth of both ends [L, 2, 3].
    """
    if not len(lines):
        return
    height, width = depth.shape
    longest = int(np.abs(lines[:, 1, :2] - lines[:, 0, :2]).max()) + 2
    t = np.linspace(0, 1, min(longest, 2 * (height + width)))[:, None, None]
    points = ((1 - t) * lines[:, 0] + t * lines[:, 1]).reshape(-1, 3)
    column, row = points[:, :2].astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, near = column[inside], row[inside], points[inside, 2]
    seen = near < depth[row, column]
    covered = np.zeros(depth.shape, bool)
    covered[row[seen], column[seen]] = True
    covered[1:] |= covered[:-1]  # two fine pixels thick
    image[covered] += (255 * np.array(EDGE_COLOUR, np.float32) - image[covered]) * EDGE_OPACITY
