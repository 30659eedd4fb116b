"""Recordings of a rollout as one HTML file that plays them, without a network and without anything installed.

The page, ``replay.html``, holds each recording as a gzip stream in base64. Numbers change little from step to step:
kept are the second differences of positions and the first ones of velocities, zigzag coded (0, -1, 1, -2, ... as 0, 1,
2, 3, ...), one plane for each byte. Links are found anew from positions; kept are those that the radio had otherwise.
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

from modgnn_rl.envs.flocking.recording import METRICS, QUANTUM, Recording
from modgnn_rl.utils.files import write_atomically

__all__ = ["pack", "replay_page", "write_replay"]

Array = NDArray[Any]

TEMPLATE = Path(__file__).with_name("replay.html")
VELOCITY_STEPS = 127  # from zero to the largest speed


def write_replay(
    path: str | os.PathLike[str], rollouts: Mapping[str, Recording], title: str, facts: Mapping[str, Any] | None = None
) -> None:
    """Write recordings of one rollout, flown by several, as a page, whole or not at all.

    Args:
        path: the file; its folder must exist.
        rollouts: recordings of equal length and size, by the name of who flies; the first two are shown at first.
        title: heading of the page.
        facts: what else is to be said of the rollout, by name.
    """
    write_atomically(path, replay_page(rollouts, title, facts or {}))


def replay_page(rollouts: Mapping[str, Recording], title: str, facts: Mapping[str, Any]) -> str:
    """The page that `write_replay` writes."""
    first = next(iter(rollouts.values()))
    steps, agents = first.present.shape
    content = {
        "agents": agents,
        "frames": steps,
        "stride": first.stride,
        "frequency": first.frequency,
        "range": first.comm_range if np.isfinite(first.comm_range) else None,
        "quantum": QUANTUM,
        "max_speed": first.max_speed,
        "velocity_steps": VELOCITY_STEPS,
        "metrics": [[name, *words] for name, words in METRICS.items()],
        "facts": {name: str(value) for name, value in facts.items()},
        "rollouts": [
            {"name": name, "data": base64.b64encode(pack(recording)).decode()} for name, recording in rollouts.items()
        ],
    }
    # Inside a script element only "<" could end the JSON.
    data = json.dumps(content, allow_nan=False).replace("<", "\\u003c")
    page = TEMPLATE.read_text(encoding="utf-8")
    return page.replace("{{title}}", html.escape(title)).replace("{{data}}", data)


def pack(recording: Recording) -> bytes:
    """A recording of N agents and T steps as a gzip stream.

    One after the other: positions, 4 byte planes [3, N, T]; velocities, in `VELOCITY_STEPS`, 2 planes [3, N, T];
    presence [N, T]; metrics, float32 [4, T]; for each step the number of flips and the differences between successive
    ones, each number as bytes of seven bits, the lowest first, of which all but the last have the eighth bit set.
    """
    scale = VELOCITY_STEPS / recording.max_speed
    position = recording.position.astype(np.int64).transpose(2, 1, 0)
    velocity = (recording.target_velocity * scale).round().astype(np.int64).transpose(2, 1, 0)
    metrics = np.stack([recording.metrics[name] for name in METRICS]).astype("<f4")
    parts = (
        _planes(_differences(_differences(position)), 4),
        _planes(_differences(velocity), 2),
        recording.present.T.astype(np.uint8).tobytes(),
        metrics.tobytes(),
        _flip_bytes(recording.flips),
    )
    return gzip.compress(b"".join(parts), 9, mtime=0)


def _differences(values: Array) -> Array:
    """Differences along the last axis, the first value being its own."""
    return np.diff(values, axis=-1, prepend=0)


def _planes(values: Array, count: int) -> bytes:
    """Signed numbers, zigzag coded, as the given number of byte planes, the lowest first."""
    zigzag = (values << 1) ^ (values >> 63)
    return b"".join(((zigzag >> 8 * plane) & 255).astype(np.uint8).tobytes() for plane in range(count))


def _flip_bytes(flips: list[Array]) -> bytes:
    numbers = np.concatenate([np.concatenate(([len(step)], np.diff(step, prepend=0))) for step in flips])
    digits = [numbers]
    while (digits[-1] > 127).any():
        digits.append(digits[-1] >> 7)
    table = np.stack(digits, 1)
    needed = (table > 0) | (np.arange(len(digits)) == 0)
    table = (table & 127) | np.where(table > 127, 128, 0)
    return table[needed].astype(np.uint8).tobytes()
