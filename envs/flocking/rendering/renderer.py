"""Pictures of a flock: agents, the leader in red, target velocities as blue arrows, communication links in yellow.

A picture is a function of the state alone, so that it is the same whichever engine moves the flock. PyBullet draws
the solid parts with its software renderer or in its window. The software renderer knows no lines, and neither edges
that are smooth nor colours that let others through: it draws at twice the size, and the links are laid over its image,
hidden by what lies nearer.
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

__all__ = ["RENDER_MODES", "Flock", "Renderer", "check_render_mode", "has_display"]

Array = NDArray[Any]

RENDER_MODES = ("human", "rgb_array")
ARROW_TIME = 1.0  # s; an arrow is as long as the way flown in this time
ARM = (0.11, 0.025)  # m, and share of the view: arms of agents, drawn longer than they are so that one sees them
LEADER_SCALE = 1.3
MAX_LINKS = 10_000  # the shortest are drawn
VIEW = np.array([-0.45, -0.85, 0.38])  # from the flock to the camera
FIELD_OF_VIEW = 30.0  # of the height, degrees
SMALLEST_VIEW = 1.0  # m from the centre to the edge
OVERSAMPLING = 2
BACKGROUND = np.array([[251, 252, 254], [229, 234, 241]])  # at the top and at the bottom
WINDOW_BACKGROUND = " ".join(f"--background_color_{name}=0.95" for name in ("red", "green", "blue"))
HAZE = 0.4  # share of the background in what is farthest away
MESHES = {
    "follower": (QUADCOPTER, (0.12, 0.15, 0.22)),
    "leader": (LEADER_SCALE * QUADCOPTER, (0.86, 0.08, 0.10)),
    "arrow": (ARROW, (0.10, 0.38, 0.90)),
}
LINK_COLOUR = (0.96, 0.74, 0.05)
LINK_OPACITY = 0.5


class Flock(NamedTuple):
    """What is drawn of a flock of N agents, the leader first.

    Attributes:
        position: m [N, 3].
        quaternion: attitudes x, y, z, w [N, 4].
        target_velocity: m/s [N, 3].
        adjacency: bool [N, N].
    """

    position: Array
    quaternion: Array
    target_velocity: Array
    adjacency: Array


class Look(NamedTuple):
    """What a body looks like: a mesh of `MESHES`, its width and its length along its z axis, m."""

    mesh: str
    width: float
    length: float


class Camera(NamedTuple):
    """Where a picture is taken from: PyBullet's view and projection matrices, as it returns them."""

    target: Array
    distance: float
    view: tuple[float, ...]
    projection: tuple[float, ...]

    def project(self, points: Array, width: int, height: int) -> Array:
        """Points [P, 3] in the picture: column, row, and depth as in PyBullet's depth buffer [P, 3]."""
        view, projection = (np.reshape(matrix, (4, 4)).T for matrix in (self.view, self.projection))
        clip = np.append(points, np.ones((len(points), 1)), -1) @ (projection @ view).T
        x, y, depth = (clip[:, :3] / clip[:, 3:]).T
        return np.stack(((1 + x) / 2 * width, (1 - y) / 2 * height, (1 + depth) / 2), -1)


class Renderer:
    """Draws flocks into arrays or into a window, in a PyBullet client of its own.

    Args:
        render_mode: ``"rgb_array"`` draws without a display, ``"human"`` in PyBullet's window.
        width: width of the picture, pixels.
        height: its height.

    Raises:
        InputError: on another mode or size, or where there is no display for a window.
    """

    def __init__(self, render_mode: str = "rgb_array", width: int = 960, height: int = 720) -> None:
        check_render_mode(render_mode)
        for name, size in (("width", width), ("height", height)):
            if not isinstance(size, int) or not 16 <= size <= 4096:
                raise InputError(f"{name}={size!r} of the picture is not a whole number from 16 to 4096")
        from modgnn_rl.envs.flocking.physics.bullet import (
            import_pybullet,  # here, since PyBullet takes a moment to load
        )

        pybullet = import_pybullet()
        self.bullet = pybullet
        self.render_mode, self.width, self.height = render_mode, width, height
        # PyBullet never gives back the memory of a shape: each is made once, and bodies that stay the same are moved.
        self.shapes: dict[Look, int] = {}
        self.shown: dict[tuple[str, int], tuple[Look, int]] = {}
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

    def draw(self, flock: Flock) -> Array | None:
        """Draw a flock; agents whose position is not finite are left out.

        Returns:
            the picture, uint8 [H, W, 3]; None in a window.

        Raises:
            InputError: when the window has been closed.
        """
        if not self.bullet.isConnected(self.client):
            raise InputError("there is nothing to draw in: the window or the environment has been closed")
        there = np.isfinite(flock.position).all(-1)
        position, quaternion, target = (np.asarray(part, np.float64)[there] for part in flock[:3])
        flock = Flock(position, quaternion, target, flock.adjacency[there][:, there])
        camera = self._camera(flock)
        links = flock.position[_links(flock)]
        if self.render_mode == "human":
            self._show(flock, camera, links)
            return None
        return self._picture(flock, camera, links)

    def close(self) -> None:
        """Close the window and end the client."""
        if self.bullet.isConnected(self.client):
            self.bullet.disconnect(self.client)

    def _camera(self, flock: Flock) -> Camera:
        """The camera that holds all agents and arrows in view."""
        points = np.concatenate((flock.position, flock.position + ARROW_TIME * flock.target_velocity))
        points = points if len(points) else np.zeros((1, 3))
        back = VIEW / np.linalg.norm(VIEW)
        right = np.cross((0, 0, 1), back)
        axes = np.stack((right / np.linalg.norm(right), np.cross(back, right / np.linalg.norm(right)), back))
        seen = points @ axes.T
        centre = (seen.min(0) + seen.max(0)) / 2
        slope = np.tan(np.radians(FIELD_OF_VIEW / 2)) * np.array((self.width / self.height, 1.0))
        offset = seen - centre
        fitting = (np.abs(offset[:, :2]) + ARM[0]) / slope + offset[:, 2:]
        distance = 1.05 * max(fitting.max(), SMALLEST_VIEW / slope[1])
        depth = np.abs(offset[:, 2]).max() + 1.0
        target = centre @ axes
        view = self.bullet.computeViewMatrix(target + distance * back, target, (0, 0, 1))
        near, far = max(distance - depth, distance / 100), distance + depth
        aspect = self.width / self.height
        return Camera(target, distance, view, self.bullet.computeProjectionMatrixFOV(FIELD_OF_VIEW, aspect, near, far))

    def _solids(self, flock: Flock, camera: Camera) -> None:
        """Put agents and arrows into the world, and take out those that are not there any more."""
        arm = round(max(ARM[0], ARM[1] * camera.distance * np.tan(np.radians(FIELD_OF_VIEW / 2))), 2)
        lengths = (ARROW_TIME * np.linalg.norm(flock.target_velocity, axis=-1)).round(2).tolist()
        directions = quaternions_along(flock.target_velocity)
        gone = set(self.shown)
        for index, length in enumerate(lengths):
            parts = [("agent", Look("follower" if index else "leader", arm, arm), flock.quaternion[index])]
            if length:
                parts.append(("arrow", Look("arrow", round(0.18 * arm, 3), length), directions[index]))
            for name, look, quaternion in parts:
                self._put((name, index), look, flock.position[index], quaternion)
                gone.discard((name, index))
        for place in gone:
            self.bullet.removeBody(self.shown.pop(place)[1], physicsClientId=self.client)

    def _put(self, place: tuple[str, int], look: Look, position: Array, quaternion: Array) -> None:
        """Show one body: the one that was in its place, if that looks as it should, or a new one."""
        bullet, client = self.bullet, self.client
        old, body = self.shown.get(place, (None, -1))
        if old == look:
            bullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
            return
        if old is not None:
            bullet.removeBody(body, physicsClientId=client)
        body = bullet.createMultiBody(0, -1, self._shape(look), position, quaternion, physicsClientId=client)
        self.shown[place] = (look, body)

    def _shape(self, look: Look) -> int:
        if look not in self.shapes:
            mesh, colour = MESHES[look.mesh]
            mesh = mesh * (look.width, look.width, look.length)
            self.shapes[look] = self.bullet.createVisualShape(
                self.bullet.GEOM_MESH,
                vertices=mesh.reshape(-1, 3).tolist(),
                indices=list(range(3 * len(mesh))),
                normals=normals(mesh).reshape(-1, 3).tolist(),
                rgbaColor=(*colour, 1.0),
                physicsClientId=self.client,
            )
        return self.shapes[look]

    def _picture(self, flock: Flock, camera: Camera, links: Array) -> Array:
        """The picture, uint8 [H, W, 3]."""
        bullet, width, height = self.bullet, OVERSAMPLING * self.width, OVERSAMPLING * self.height
        self._solids(flock, camera)
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
        fine[solid] += (np.reshape(colours, (height, width, 4))[solid][:, :3] - fine[solid]) * _clearness(depth[solid])
        _overlay(fine, depth, camera.project(links.reshape(-1, 3), width, height).reshape(-1, 2, 3))
        offsets = range(OVERSAMPLING)
        parts = [fine[row::OVERSAMPLING, column::OVERSAMPLING] for row in offsets for column in offsets]
        image: Array = sum(parts[1:], parts[0]) / len(parts)
        return image.round().astype(np.uint8)

    def _show(self, flock: Flock, camera: Camera, links: Array) -> None:
        """Draw in the window; links are lines there."""
        bullet, client = self.bullet, self.client
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 0, physicsClientId=client)
        is_new = not self.shown
        self._solids(flock, camera)
        old, self.lines = self.lines, []
        for index, (begin, end) in enumerate(links.tolist()):
            replaced = old[index] if index < len(old) else -1
            line = bullet.addUserDebugLine(
                begin, end, LINK_COLOUR, replaceItemUniqueId=replaced, physicsClientId=client
            )
            self.lines.append(line)
        for line in old[len(links) :]:
            bullet.removeUserDebugItem(line, physicsClientId=client)
        # The window follows the flock; from where and how far away is for the user's mouse to say.
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
    try:  # PyBullet would end the process
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)


def check_render_mode(render_mode: str | None) -> None:
    """Refuse what cannot be drawn.

    Raises:
        InputError: on a mode that there is not, or on a window where there is no display.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise InputError(f"render_mode={render_mode!r} is not one of {', '.join(RENDER_MODES)}")
    if render_mode == "human" and not has_display():
        raise InputError('render_mode="human" needs a display and there is none; use render_mode="rgb_array"')


def _links(flock: Flock) -> Array:
    """Pairs of agents with a link in either direction, the shortest `MAX_LINKS` of them [L, 2]."""
    pairs = np.argwhere(np.triu(flock.adjacency | flock.adjacency.T, 1))
    if len(pairs) > MAX_LINKS:
        length = np.linalg.norm(flock.position[pairs[:, 0]] - flock.position[pairs[:, 1]], axis=-1)
        pairs = pairs[np.argpartition(length, MAX_LINKS)[:MAX_LINKS]]
    return pairs


def _clearness(depth: Array) -> Array:
    """How much of the background does not shine through, by depth [P] -> [P, 1]: the nearest is the clearest."""
    if not len(depth):
        return depth[:, None]
    nearest, farthest = depth.min(), depth.max()
    return 1 - HAZE * ((depth - nearest) / max(farthest - nearest, 1e-9))[:, None]


def _overlay(image: Array, depth: Array, lines: Array) -> None:
    """Lay lines over an image [H, W, 3], where nothing of the depth buffer [H, W] is nearer.

    Args:
        image: is changed.
        depth: as PyBullet gives it.
        lines: column, row and depth of both ends [L, 2, 3].
    """
    if not len(lines):
        return
    height, width = depth.shape
    longest = int(np.abs(lines[:, 1, :2] - lines[:, 0, :2]).max()) + 2
    share = np.linspace(0, 1, min(longest, 2 * (height + width)))[:, None, None]
    points = ((1 - share) * lines[:, 0] + share * lines[:, 1]).reshape(-1, 3)
    column, row = points[:, :2].astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, near = column[inside], row[inside], points[inside, 2]
    seen = near < depth[row, column]
    covered = np.zeros(depth.shape, bool)
    covered[row[seen], column[seen]] = True
    covered[1:] |= covered[:-1]  # two fine pixels thick
    image[covered] += (255 * np.array(LINK_COLOUR, np.float32) - image[covered]) * LINK_OPACITY
