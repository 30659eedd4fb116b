"""Recordings as one HTML file that plays them in a browser, offline and without any installation.

The page, ``replay.html``, holds each recording as a gzip stream in base64. Values change little from step to step, so
the stream holds second differences of positions and first differences of arrows and marks, zigzag coded (0, -1, 1, -2,
... as 0, 1, 2, 3, ...), one plane per byte. The page computes edges from positions and flips those that are listed.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.utils.files import write_atomically
from modgnn_rl.visualization.recording import QUANTUM, Recording

__all__ = ["pack", "replay_page", "write_replay"]

Array = NDArray[Any]

TEMPLATE = Path(__file__).with_name("replay.html")
ARROW_STEPS = 127  # quantisation steps of the components of arrows, from zero to the longest


def write_replay(
    path: str | os.PathLike[str],
    recordings: Mapping[str, Recording],
    title: str,
    facts: Mapping[str, Any] | None = None,
) -> None:
    """Write rollouts of several policies from the same initial state as a page, atomically.

    Args:
        path: the file; its folder must exist.
        recordings: of equal size, by the name of the acting policy; the first two are shown initially.
        title: heading of the page.
        facts: further information on the rollout, by name.
    """
    write_atomically(path, replay_page(recordings, title, facts or {}))


def replay_page(recordings: Mapping[str, Recording], title: str, facts: Mapping[str, Any]) -> str:
    """The HTML of the page, see `write_replay`."""
    first = next(iter(recordings.values()))
    agents = first.present.shape[1]
    steps = max(map(len, recordings.values()))  # an episode that ends early holds its last frame
    content = {
        "agents": agents,
        "frames": steps,
        "stride": first.stride,
        "frequency": first.frequency,
        "range": first.comm_range if np.isfinite(first.comm_range) else None,
        "quantum": QUANTUM,
        "max_arrow": max(recording.max_arrow for recording in recordings.values()),
        "arrow": first.arrow_name,
        "leader": -1 if first.leader is None else first.leader,
        "dims": first.dims,
        "marks": 0 if first.marks is None else first.marks.shape[1],
        "arrow_steps": ARROW_STEPS,
        "metrics": [[name, series.title, series.unit] for name, series in first.metrics.items()],
        "facts": {name: str(value) for name, value in facts.items()},
        "rollouts": [
            {
                "name": name,
                "frames": len(recording),
                "data": base64.b64encode(pack(recording.extended(steps))).decode(),
            }
            for name, recording in recordings.items()
        ],
    }
    # Inside a script element, only "<" could end the JSON.
    data = json.dumps(content, allow_nan=False).replace("<", "\\u003c")
    page = TEMPLATE.read_text(encoding="utf-8")
    return page.replace("{{title}}", html.escape(title)).replace("{{data}}", data)


def pack(recording: Recording) -> bytes:
    """Encode a recording of N agents, T steps and M metrics as a gzip stream.

    Its parts are, in this order: positions, 4 byte planes [3, N, T]; arrows, in `ARROW_STEPS`, 2 byte planes [3, N, T];
    marks, 4 byte planes [3, P, T]; presence [N, T]; metrics, float32 [M, T]; and for each step the number of flips and
    the differences between consecutive flips, as variable-length integers of seven bits per byte, lowest first, all
    bytes but the last of which have the eighth bit set.
    """
    scale = ARROW_STEPS / recording.max_arrow
    position = recording.position.astype(np.int64).transpose(2, 1, 0)
    arrow = (recording.arrow * scale).round().astype(np.int64).transpose(2, 1, 0)
    marks = np.zeros((len(recording), 0, 3), np.int64) if recording.marks is None else recording.marks.astype(np.int64)
    metrics = np.array([series.values for series in recording.metrics.values()], "<f4")
    parts = (
        _planes(_differences(_differences(position)), 4),
        _planes(_differences(arrow), 2),
        _planes(_differences(marks.transpose(2, 1, 0)), 4),
        recording.present.T.astype(np.uint8).tobytes(),
        metrics.tobytes(),
        _flip_bytes(recording.flips),
    )
    return gzip.compress(b"".join(parts), 9, mtime=0)


def _differences(values: Array) -> Array:
    """Differences along the last axis, starting with the first value itself."""
    return np.diff(values, axis=-1, prepend=0)


def _planes(values: Array, count: int) -> bytes:
    """Signed integers, zigzag coded, as the given number of byte planes, lowest first."""
    zigzag = (values << 1) ^ (values >> 63)
    return b"".join(((zigzag >> 8 * plane) & 255).astype(np.uint8).tobytes() for plane in range(count))


def _flip_bytes(flips: list[Array]) -> bytes:
    """Counts and differences of the flips of all steps as variable-length integers, see `pack`."""
    numbers = np.concatenate([np.concatenate(([len(step)], np.diff(step, prepend=0))) for step in flips])
    digits = [numbers]
    while (digits[-1] > 127).any():
        digits.append(digits[-1] >> 7)
    table = np.stack(digits, 1)
    needed = (table > 0) | (np.arange(len(digits)) == 0)
    table = (table & 127) | np.where(table > 127, 128, 0)
    return table[needed].astype(np.uint8).tobytes()
