"""Pictures of a flock: agents, the leader in red, target velocities as blue arrows, communication links in yellow.

A picture is a function of the state alone, so that it is the same whichever engine moves the flock. PyBullet draws
the solid parts, one triangle mesh a colour, with its software renderer or in its window. The software renderer knows
no lines, and neither edges that are smooth nor colours that let others through: it draws at twice the size, and the
links are laid over its image, hidden by what lies nearer.
"""

from __future__ import annotations

import os
import sys
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.envs.shapes import ARROW, QUADCOPTER, along, copies, normals, rotations
from modgnn_rl.errors import InputError

__all__ = ["RENDER_MODES", "Flock", "Renderer", "check_render_mode", "has_display"]

Array = NDArray[Any]

RENDER_MODES = ("human", "rgb_array")
ARROW_TIME = 1.0  # s; an arrow is as long as the way flown in this time
ARM = (0.11, 0.025)  # m, and share of the view: arms of agents, drawn longer than they are so that one sees them
LEADER_SCALE = 1.3
MAX_LINKS = 10_000  # the shortest are drawn
AGENTS_IN_MESH = 32  # PyBullet's meshes are limited in size
VIEW = np.array([-0.45, -0.85, 0.38])  # from the flock to the camera
FIELD_OF_VIEW = 30.0  # of the height, degrees
SMALLEST_VIEW = 1.0  # m from the centre to the edge
OVERSAMPLING = 2
BACKGROUND = np.array([[251, 252, 254], [229, 234, 241]])  # at the top and at the bottom
HAZE = 0.5  # share of the background in what is farthest away
FOLLOWER_COLOUR = (0.12, 0.15, 0.22)
LEADER_COLOUR = (0.86, 0.08, 0.10)
ARROW_COLOUR = (0.10, 0.38, 0.90)
LINK_COLOUR = (0.96, 0.74, 0.05)
LINK_OPACITY = 0.42


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
        from modgnn_rl.envs.bullet import import_pybullet  # here, since PyBullet takes a moment to load

        pybullet = import_pybullet()
        self.bullet = pybullet
        self.render_mode, self.width, self.height = render_mode, width, height
        self.shown: list[int] = []
        if render_mode == "rgb_array":
            self.client = pybullet.connect(pybullet.DIRECT)
            return
        try:
            self.client = pybullet.connect(pybullet.GUI, options=f"--width={width} --height={height}")
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
        """Put agents and arrows into the world."""
        arm = max(ARM[0], ARM[1] * camera.distance * np.tan(np.radians(FIELD_OF_VIEW / 2)))
        for start in range(0, len(flock.position), AGENTS_IN_MESH):
            part = slice(start, start + AGENTS_IN_MESH)
            position, turned = flock.position[part], arm * rotations(flock.quaternion[part])
            first = 1 if start == 0 else 0
            self._add(copies(QUADCOPTER, turned[first:], position[first:]), FOLLOWER_COLOUR)
            self._add(copies(QUADCOPTER, LEADER_SCALE * turned[:first], position[:first]), LEADER_COLOUR)
            arrows = along(ARROW_TIME * flock.target_velocity[part], 0.18 * arm)
            self._add(copies(ARROW, arrows, position), ARROW_COLOUR)

    def _add(self, mesh: Array, colour: tuple[float, float, float]) -> None:
        """Put triangles [T, 3, 3] into the world."""
        if not len(mesh):
            return
        shape = self.bullet.createVisualShape(
            self.bullet.GEOM_MESH,
            vertices=mesh.reshape(-1, 3).tolist(),
            indices=list(range(3 * len(mesh))),
            normals=normals(mesh).reshape(-1, 3).tolist(),
            rgbaColor=(*colour, 1.0),
            physicsClientId=self.client,
        )
        self.shown.append(self.bullet.createMultiBody(0, baseVisualShapeIndex=shape, physicsClientId=self.client))

    def _clear(self) -> None:
        for body in self.shown:
            self.bullet.removeBody(body, physicsClientId=self.client)
        self.shown.clear()

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
        self._clear()
        fine = np.linspace(BACKGROUND[0], BACKGROUND[1], height).astype(np.float32)[:, None].repeat(width, 1)
        depth = np.reshape(depth, (height, width))
        solid = np.reshape(bodies, (height, width)) >= 0
        fine[solid] += (np.reshape(colours, (height, width, 4))[solid][:, :3] - fine[solid]) * _clearness(depth[solid])
        _overlay(fine, depth, camera.project(links.reshape(-1, 3), width, height).reshape(-1, 2, 3))
        image = fine.reshape(self.height, OVERSAMPLING, self.width, OVERSAMPLING, 3)
        return (image.sum((1, 3)) / OVERSAMPLING**2).round().astype(np.uint8)

    def _show(self, flock: Flock, camera: Camera, links: Array) -> None:
        """Draw in the window; links are lines there."""
        bullet, client = self.bullet, self.client
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 0, physicsClientId=client)
        self._clear()
        self._solids(flock, camera)
        bullet.removeAllUserDebugItems(physicsClientId=client)
        for begin, end in links.tolist():
            bullet.addUserDebugLine(begin, end, LINK_COLOUR, physicsClientId=client)
        yaw = np.degrees(np.arctan2(VIEW[1], VIEW[0])) + 90
        pitch = -np.degrees(np.arcsin(VIEW[2] / np.linalg.norm(VIEW)))
        bullet.resetDebugVisualizerCamera(camera.distance / 2, yaw, pitch, camera.target, physicsClientId=client)
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 1, physicsClientId=client)


def has_display() -> bool:
    """Whether there is a display for a window."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


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
