"""Rendered images: all parts are visible in their colours and stay in view."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

from modgnn_rl.envs.flocking.rendering.meshes import ARROW, QUADCOPTER, normals, quaternions_along
from modgnn_rl.envs.flocking.rendering.renderer import Renderer
from modgnn_rl.errors import InputError
from modgnn_rl.visualization.recording import Frame


def flock(position: list[list[float]], *, speed: float = 0.0, linked: bool = False) -> Frame:
    count = len(position)
    return Frame(
        position=np.array(position, float).reshape(-1, 3),
        arrow=np.tile([speed, 0.0, 0.0], (count, 1)),
        edges=np.argwhere(np.full((count, count), linked) & ~np.eye(count, dtype=bool)),
        present=np.ones(count, bool),
    )


def draw(frame: Frame) -> np.ndarray:
    renderer = Renderer(width=160, height=120)
    image = renderer.draw(frame)
    renderer.close()
    assert image is not None
    assert image.dtype == np.uint8
    assert image.shape == (120, 160, 3)
    return image.astype(int)


def fractions(image: np.ndarray) -> tuple[float, float, float, float]:
    """Fractions of the image that are red, blue, yellow and dark."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return (
        float(((red > 130) & (green < 140) & (blue < 140)).mean()),
        float(((blue > 120) & (red < 0.75 * blue)).mean()),
        float(((red > 180) & (blue < 0.85 * red)).mean()),
        float(((image.sum(-1) < 480) & (image.max(-1) - image.min(-1) < 40)).mean()),
    )


CORNERS = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]


def test_each_thing_has_its_colour() -> None:
    bare, arrows, edges = (
        fractions(draw(flock(CORNERS))),
        fractions(draw(flock(CORNERS, speed=0.9))),
        fractions(draw(flock(CORNERS, linked=True))),
    )
    assert bare[0] > 0.001  # the leader
    assert bare[3] > 0.0005  # the others
    assert arrows[1] > bare[1] + 0.005
    assert edges[2] > bare[2] + 0.003


def test_the_camera_follows_the_flock_and_fits_its_size() -> None:
    image = draw(flock(CORNERS, linked=True))
    far = [[x + 1000.0, y - 500.0, z + 20.0] for x, y, z in CORNERS]
    assert np.abs(draw(flock(far, linked=True)) - image).mean() < 1.0
    wide = fractions(draw(flock([[20 * c for c in corner] for corner in CORNERS])))
    assert wide[3] > 0.0002  # agents are drawn large enough to see


def test_agents_without_a_position_are_left_out() -> None:
    image = draw(flock([*CORNERS, [np.nan, 0, 0]], linked=True))
    assert np.array_equal(image, draw(flock(CORNERS, linked=True)))
    draw(flock([[np.nan] * 3]))
    draw(flock([[1.0, 2.0, 3.0]]))


def test_gymnasium_renders_images() -> None:
    env = gymnasium.make("modgnn_rl/Flocking-v0", num_agents=40, render_mode="rgb_array", width=160, height=120)
    env.reset(seed=0)
    image = env.render()
    assert isinstance(image, np.ndarray)
    assert image.std() > 5
    env.close()


def test_further_images_create_no_further_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyBullet never frees a shape, so bodies are moved instead of created again."""
    renderer = Renderer(width=32, height=32)
    created: list[str] = []

    def count(name: str) -> None:
        make = getattr(renderer.bullet, name)

        def counted(*args: Any, **options: Any) -> int:
            created.append(name)
            return int(make(*args, **options))

        monkeypatch.setattr(renderer.bullet, name, counted)

    count("createVisualShape")
    count("createMultiBody")
    renderer.draw(flock(CORNERS, speed=0.9))
    assert created.count("createVisualShape") == 3  # a leader, a follower, an arrow
    assert created.count("createMultiBody") == 8
    renderer.draw(flock([[x + 0.1, y, z] for x, y, z in CORNERS], speed=0.9))
    renderer.draw(flock(CORNERS[:2]))
    assert len(created) == 11
    assert renderer.bullet.getNumBodies(renderer.client) == 2
    renderer.draw(flock(CORNERS, speed=0.9))
    assert created[11:] == 6 * ["createMultiBody"]
    renderer.close()


def test_an_image_does_not_depend_on_previous_images() -> None:
    renderer, fresh = (Renderer(width=64, height=48) for _ in range(2))
    frame = flock(CORNERS, speed=0.9, linked=True)
    expected = fresh.draw(frame)
    for before in (flock(CORNERS[:3], speed=0.3), flock([]), flock([[9.0, 9.0, 9.0], *CORNERS], linked=True)):
        renderer.draw(before)
        image = renderer.draw(frame)
        assert image is not None
        assert expected is not None
        assert np.array_equal(image, expected)
    renderer.close()
    fresh.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems always have a display")
@pytest.mark.parametrize("display", ["", ":4711"])
def test_a_window_needs_a_display_that_answers(display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(InputError, match='needs a display and there is none; use render_mode="rgb_array"'):
        Renderer("human")
    with pytest.raises(InputError, match="needs a display"):
        gymnasium.make("modgnn_rl/Flocking-v0", num_agents=2, render_mode="human")


def test_invalid_render_settings_are_errors() -> None:
    with pytest.raises(InputError, match="'ansi' is not one of human, rgb_array"):
        Renderer("ansi")
    with pytest.raises(InputError, match="width=0"):
        Renderer(width=0)
    renderer = Renderer(width=32, height=32)
    renderer.close()
    with pytest.raises(InputError, match="has been closed"):
        renderer.draw(flock(CORNERS))


def test_arrows_point_along_vectors() -> None:
    vectors = np.array([[0.0, 0.0, 2.0], [1.0, 2.0, -2.0], [0.0, 0.0, -3.0], [1e-4, 0.0, -1.0], [0.0, 0.0, 0.0]])
    quaternions = quaternions_along(vectors)
    assert np.allclose(np.linalg.norm(quaternions, axis=-1), 1)
    for vector, (x, y, z, w) in zip(vectors[:4], quaternions[:4], strict=True):
        turned = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # the z axis
        assert np.allclose(turned, vector / np.linalg.norm(vector), atol=1e-6)


def test_meshes_have_unit_size() -> None:
    assert (ARROW[..., 2].min(), ARROW[..., 2].max()) == (0, 1)
    assert 1 < np.linalg.norm(QUADCOPTER[..., :2], axis=-1).max() < 1.6
    assert np.allclose(np.linalg.norm(normals(ARROW), axis=-1), 1)
