"""A live view of a rollout in a browser on the same machine; needs ``modgnn-rl[viewer]``."""

from __future__ import annotations

import socket
import time
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.errors import InputError
from modgnn_rl.visualization.recording import Frame, shortest_edges

__all__ = ["Viewer"]

HOST = "127.0.0.1"
BROWSER_TIMEOUT = 30.0  # s to wait for a browser before the rollout starts without one
MAX_EDGES = 3000  # the shortest are drawn
MAX_RATE = 24.0  # frames per second
COLOURS = {"agent": (23, 32, 51), "leader": (208, 31, 46), "edge": (227, 181, 5), "target": (27, 98, 208)}


class Viewer:
    """Shows frames at the pace of the control frequency, or slower. A context manager; call it with each frame.

    Args:
        frequency: control frequency, Hz.
        port: port of the web page, on this machine.
        timeout: longest wait for a browser before the rollout starts, s.

    Raises:
        InputError: viser is not installed, or the port is in use.
    """

    def __init__(self, frequency: float, port: int, timeout: float = BROWSER_TIMEOUT) -> None:
        try:
            import viser
        except ImportError as error:
            raise InputError(
                "viewer=true needs viser, which is not installed: pip install 'modgnn-rl[viewer]'"
            ) from error
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError as error:
                raise InputError(f"port={port} cannot be used ({error.strerror}); choose another one") from error
        self.frequency, self.timeout = frequency, timeout
        self.server: Any = viser.ViserServer(host=HOST, port=port, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.scene.add_grid("/floor", width=40.0, height=40.0, cell_size=1.0, position=(0.0, 0.0, -5.0))
        self.follows = self.server.gui.add_checkbox("Follow the flock", True)
        self.shows_edges = self.server.gui.add_checkbox("Edges", True)
        self.clock = self.server.gui.add_text("Time", "0.0 s", disabled=True)
        self.url = f"http://{HOST}:{port}"
        self.steps = 0
        self.started = self.drawn = 0.0

    def __enter__(self) -> Self:
        """Print the address, and wait for a browser."""
        print(
            f"Open {self.url} to watch; the rollout starts when a browser connects, or in {self.timeout:.0f} s",
            flush=True,
        )
        end = time.monotonic() + self.timeout
        while not self.server.get_clients() and time.monotonic() < end:
            time.sleep(0.1)
        self.started = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the server."""
        self.server.stop()

    def __call__(self, frame: Frame) -> None:
        """Wait until the frame is due, and show it."""
        due = self.started + self.steps / self.frequency
        if (early := due - time.monotonic()) > 0:
            time.sleep(early)
        else:
            self.started -= early  # a rollout that falls behind does not catch up
        if self.steps == 0 or time.monotonic() - self.drawn > 1 / MAX_RATE:
            self.drawn = time.monotonic()
            self.clock.value = f"{self.steps / self.frequency:.1f} s"
            self._draw(frame)
        self.steps += 1

    def _draw(self, frame: Frame) -> None:
        position = frame.position - (frame.position.mean(0) if self.follows.value else 0.0)
        position, arrow = position.astype(np.float32), frame.arrow.astype(np.float32)
        leads = np.arange(len(position)) == (-1 if frame.leader is None else frame.leader)
        pairs = shortest_edges(frame, MAX_EDGES if self.shows_edges.value else 0)
        scene = self.server.scene
        with self.server.atomic():
            scene.add_point_cloud("/agents", position[~leads], COLOURS["agent"], point_size=0.12, point_shape="circle")
            if leads.any():
                scene.add_point_cloud(
                    "/leader", position[leads], COLOURS["leader"], point_size=0.24, point_shape="diamond"
                )
            for name, lines in (
                ("edge", position[pairs]),
                ("target", np.stack((position, position + arrow), 1)[~leads]),
            ):
                self._add_lines(name, lines)

    def _add_lines(self, name: str, lines: NDArray[Any]) -> None:
        """Show lines [L, 2, 3]; without any, one of zero length."""
        lines = lines if len(lines) else np.zeros((1, 2, 3), np.float32)
        width = 2.5 if name == "target" else 1.0
        self.server.scene.add_line_segments(f"/{name}", lines, COLOURS[name], line_width=width)
