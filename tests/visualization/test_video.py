"""Films of flocks: what is in them, and that a file is whole or not there."""

from __future__ import annotations

import importlib.util
import io

import numpy as np
import pytest
import torch

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.errors import InputError
from modgnn_rl.visualization.video import Frame, as_gif, film, write_video


def _frames(env_config, steps=12, agents=5):
    expert = Reynolds.for_env(env_config, action=("agents", "action"))
    return film(expert, env_config, num_agents=agents, steps=steps, seed=3)


def test_a_film_follows_the_flight():
    env_config = FlockingConfig(num_agents=5)
    frames = _frames(env_config)
    assert len(frames) == 6
    for frame in frames:
        distance = np.linalg.norm(frame.position[:, None] - frame.position, axis=-1)
        heard = np.argwhere(np.triu(distance <= env_config.comm_range, 1))
        assert (frame.links == heard).all()
    # Two steps move an agent by what its velocity, below 1 m/s and at first that of the last target, allows.
    moved = np.linalg.norm(frames[-1].position - frames[0].position, axis=-1)
    assert ((moved > 0) & (moved < 10 / env_config.control_frequency)).all()
    assert all((one.position == other.position).all() for one, other in zip(frames, _frames(env_config), strict=True))


def test_a_list_of_links_gives_the_same_film():
    one, other = (_frames(FlockingConfig(num_agents=5, graph=graph))[0] for graph in ("matrix", "links"))
    assert (one.links == other.links).all()


def test_films_draw_from_no_global_generator():
    before = torch.get_rng_state()
    _frames(FlockingConfig(num_agents=5), steps=4)
    assert torch.equal(before, torch.get_rng_state())


def test_a_video_shows_every_frame_and_the_leader_in_red(tmp_path):
    av = pytest.importorskip("av")
    pytest.importorskip("matplotlib")
    position = np.zeros((4, 3))
    position[0, 0], position[3] = 2.0, np.nan  # one that does not exist
    frames = [Frame(position, np.zeros((4, 3)), np.array([[0, 1]]))] * 7
    write_video(tmp_path / "rollout.mp4", frames, 48.0)
    with av.open(str(tmp_path / "rollout.mp4")) as file:
        assert file.streams.video[0].average_rate == 24
        pictures = [picture.to_ndarray(format="rgb24").astype(int) for picture in file.decode(video=0)]
    assert len(pictures) == 7
    red = (pictures[-1][..., 0] > 150) & (pictures[-1][..., 1:].max(-1) < 100)
    half = red.shape[1] // 2
    for view in (red[:, :half], red[:, half:]):  # right of the centre, in the middle of the height
        row, column = (places.mean() / size for places, size in zip(np.nonzero(view), view.shape, strict=True))
        assert column > 0.6
        assert 0.4 < row < 0.6
    gif, width, height = as_gif(tmp_path / "rollout.mp4")
    with av.open(io.BytesIO(gif)) as file:
        stream = file.streams.video[0]
        assert (stream.width, stream.height) == (width, height)
        assert len(list(file.decode(video=0))) == 3


def test_a_video_is_whole_or_not_there(tmp_path):
    pytest.importorskip("av")
    pytest.importorskip("matplotlib")
    frame = Frame(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((0, 2), int))
    broken = Frame(np.ones((3, 3)), np.zeros((2, 3)), np.zeros((0, 2), int))
    with pytest.raises(ValueError, match="shape"):
        write_video(tmp_path / "rollout.mp4", [frame, broken], 48.0)
    assert list(tmp_path.iterdir()) == []


def test_missing_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install av matplotlib"):
        write_video(tmp_path / "rollout.mp4", [], 48.0)
