"""Videos of flocks: their content, and that files are written atomically."""

from __future__ import annotations

import importlib.util
import io
from typing import Any

import numpy as np
import pytest
import torch

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.recording import record
from modgnn_rl.visualization.recording import Recording, quantise, range_flips, shortest_edges
from modgnn_rl.visualization.video import VIDEO_STRIDE, as_gif, write_video


def _record(env_config, steps=12):
    expert = Reynolds.for_env(env_config, action=("agents", "action"))
    return record(expert, FlockingTask(env_config), num_agents=5, steps=steps, seed=3, stride=VIDEO_STRIDE)


def _recording(position: Any, present: Any, edges: Any, frames: int) -> Recording:
    """The same frame several times."""
    quanta, count = quantise(np.asarray(position, float)), len(position)
    return Recording(
        position=np.tile(quanta, (frames, 1, 1)),
        arrow=np.zeros((frames, count, 3)),
        present=np.tile(np.array(present, bool), (frames, 1)),
        flips=[range_flips(np.array(edges).reshape(-1, 2), quanta, np.array(present, bool), 0.1)] * frames,
        metrics={},
        stride=VIDEO_STRIDE,
        comm_range=0.1,
        max_arrow=1.0,
        leader=0,
        frequency=48.0,
    )


def test_recorded_frames_follow_the_rollout():
    env_config = FlockingConfig(num_agents=5)
    recording = _record(env_config, steps=48)
    assert len(recording) == 24
    frames = [recording.frame(index) for index in range(24)]
    for frame in frames:
        distance = np.linalg.norm(frame.position[:, None] - frame.position, axis=-1)
        edges = np.argwhere(np.triu(distance <= env_config.comm_range, 1))
        shortest = shortest_edges(frame, 100)
        assert sorted(shortest.tolist()) == edges.tolist()
        assert (np.diff(distance[tuple(shortest.T)]) >= 0).all()
        assert (shortest_edges(frame, 2) == shortest[:2]).all()
    # In 46 steps an agent moves by less than its speed, below 1 m/s, allows.
    moved = np.linalg.norm(frames[-1].position - frames[0].position, axis=-1)
    assert ((moved > 0) & (moved < 46 / env_config.control_frequency)).all()
    assert (recording.position == _record(env_config, steps=48).position).all()


def test_an_edge_list_gives_the_same_frames_as_a_matrix():
    one, other = (_record(FlockingConfig(num_agents=5, graph=graph)).frame(0) for graph in ("matrix", "links"))
    assert (one.edges == other.edges).all()


def test_recordings_leave_the_global_generator_alone():
    before = torch.get_rng_state()
    _record(FlockingConfig(num_agents=5), steps=4)
    assert torch.equal(before, torch.get_rng_state())


def test_a_video_shows_every_frame_and_the_leader_in_red(tmp_path):
    av = pytest.importorskip("av")
    pytest.importorskip("matplotlib")
    position = [[2, 0, 0], [0, 0, 0], [0, 0, 0], [50, 0, 0]]
    recording = _recording(position, [1, 1, 1, 0], [[0, 1]], frames=7)  # the last agent has dropped out
    write_video(tmp_path / "rollout.mp4", recording)
    with av.open(str(tmp_path / "rollout.mp4")) as file:
        assert file.streams.video[0].average_rate == 24
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in file.decode(video=0)]
    assert len(images) == 7
    red = (images[-1][..., 0] > 150) & (images[-1][..., 1:].max(-1) < 100)
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


def test_a_failed_video_leaves_no_file(tmp_path):
    pytest.importorskip("av")
    pytest.importorskip("matplotlib")
    recording = _recording(np.zeros((3, 3)), [1, 1, 1], [], frames=2)
    del recording.flips[1]  # the second frame fails
    with pytest.raises(IndexError):
        write_video(tmp_path / "rollout.mp4", recording)
    assert list(tmp_path.iterdir()) == []


def test_missing_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install av matplotlib"):
        write_video(tmp_path / "rollout.mp4", _recording(np.zeros((1, 3)), [1], [], frames=1))
