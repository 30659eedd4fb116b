"""A rollout watched in a browser while it is flown, on this machine alone; needs ``modgnn-rl[viewer]``."""

from __future__ import annotations

import socket
import time
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.errors import InputError
from modgnn_rl.nn.topology import as_matrix

__all__ = ["Viewer"]

HOST = "127.0.0.1"
PATIENCE = 30.0  # s to wait for a browser before the rollout begins without one
MOST_LINKS = 3000  # the shortest are drawn
PICTURES = 24.0  # a second at most
COLOURS = {"agent": (23, 32, 51), "leader": (208, 31, 46), "link": (227, 181, 5), "target": (27, 98, 208)}


class Viewer:
    """Shows the first flock that `modgnn_rl.evaluation.rollout.rollout` shows it, at the pace of its clock or slower.

    Args:
        config: the world.
        port: where a browser finds it, on this machine.
        patience: longest wait for a browser before the rollout begins, s.

    Raises:
        InputError: viser is not installed, or the port is taken.
    """

    def __init__(self, config: FlockingConfig, port: int, patience: float = PATIENCE) -> None:
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
                raise InputError(f"port={port} cannot be used ({error.strerror}); give another one") from error
        self.config, self.patience = config, patience
        self.server: Any = viser.ViserServer(host=HOST, port=port, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.scene.add_grid("/floor", width=40.0, height=40.0, cell_size=1.0, position=(0.0, 0.0, -5.0))
        self.follows = self.server.gui.add_checkbox("Follow the flock", True)
        self.shows_links = self.server.gui.add_checkbox("Links", True)
        self.clock = self.server.gui.add_text("Time", "0.0 s", disabled=True)
        self.url = f"http://{HOST}:{port}"
        self.steps = 0
        self.begun = self.drawn = 0.0

    def __enter__(self) -> Self:
        """Say where to look, and wait a while for somebody to do so."""
        print(
            f"Watch at {self.url}; the rollout begins when a browser is there, or in {self.patience:.0f} s", flush=True
        )
        end = time.monotonic() + self.patience
        while not self.server.get_clients() and time.monotonic() < end:
            time.sleep(0.1)
        self.begun = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        """End the server."""
        self.server.stop()

    def __call__(self, tensordict: TensorDictBase) -> None:
        """Show the flock before a step, and wait until it is due."""
        due = self.begun + self.steps / self.config.control_frequency
        if (early := due - time.monotonic()) > 0:
            time.sleep(early)
        else:
            self.begun -= early  # a rollout that is slower than its clock does not hurry afterwards
        if self.steps == 0 or time.monotonic() - self.drawn > 1 / PICTURES:
            self.drawn = time.monotonic()
            self.clock.value = f"{self.steps / self.config.control_frequency:.1f} s"
            self._draw(tensordict[0])
        self.steps += 1

    def _draw(self, flock: TensorDictBase) -> None:
        position = flock[self.config.state_key][..., :3].cpu().numpy()
        target = flock["agents", "action"].cpu().numpy()
        if self.follows.value:
            position = position - position.mean(0)
        adjacency = as_matrix(flock["adjacency"].unsqueeze(0), len(position))[0].cpu().numpy()
        pairs = np.argwhere(np.triu(adjacency | adjacency.T, 1))
        length = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=-1)
        pairs = pairs[np.argsort(length)[:MOST_LINKS]] if self.shows_links.value else pairs[:0]
        scene = self.server.scene
        with self.server.atomic():
            scene.add_point_cloud("/agents", position[1:], COLOURS["agent"], point_size=0.12, point_shape="circle")
            scene.add_point_cloud("/leader", position[:1], COLOURS["leader"], point_size=0.24, point_shape="diamond")
            for name, lines in (("link", position[pairs]), ("target", np.stack((position, position + target), 1)[1:])):
                self._lines(name, lines)

    def _lines(self, name: str, lines: NDArray[Any]) -> None:
        """Show lines [L, 2, 3]; none at all are one without length."""
        lines = lines if len(lines) else np.zeros((1, 2, 3), np.float32)
        width = 2.5 if name == "target" else 1.0
        self.server.scene.add_line_segments(f"/{name}", lines, COLOURS[name], line_width=width)
