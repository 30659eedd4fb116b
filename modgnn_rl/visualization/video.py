"""Films of flocks: seen from above and from the side, agents dark, the leader red, links yellow, targets as arrows."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import set_recurrent_mode

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import make_eval_env
from modgnn_rl.nn.topology import as_matrix

__all__ = ["Frame", "as_gif", "check_video", "film", "write_video"]

Array = NDArray[Any]

SIZE = (800, 400)  # pixels
DPI = 72
STRIDE = 2  # control steps from one picture to the next
MAX_LINKS = 2000  # the shortest are drawn
GIF_SIZE = (600, 300)  # pixels
GIF_STRIDE = 3  # pictures of the film from one of the GIF to the next
VIEWS = {"from above": (0, 1), "from the side": (0, 2)}
NAMES = "xyz"


class Frame(NamedTuple):
    """What is drawn of N agents, the leader first.

    Attributes:
        position: m [N, 3]; those not finite are left out.
        target_velocity: m/s [N, 3].
        links: pairs of agents [L, 2].
    """

    position: Array
    target_velocity: Array
    links: Array


def check_video() -> None:
    """Check that films can be made.

    Raises:
        InputError: a package that it takes is not installed.
    """
    missing = [name for name in ("av", "matplotlib") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"films need packages that are not installed: pip install {' '.join(missing)}")


@torch.no_grad()
def film(
    policy: TensorDictModuleBase,
    config: FlockingConfig,
    *,
    num_agents: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> list[Frame]:
    """Fly a fresh flock with a policy and keep what every second control step looks like.

    Args:
        policy: reads the environment's keys, writes ``("agents", "action")``; its recurrent state is added by itself.
        config: the world.
        num_agents: agents in the flock.
        steps: steps of the rollout, which goes on whatever happens to the flock.
        seed: seed of start and leader.
        device: where to fly.
    """
    env = make_eval_env(policy, config, 1, num_agents, steps=steps, seed=seed, device=device)
    frames = []
    with contextlib.closing(env), set_recurrent_mode(False):
        tensordict = env.reset()
        for step in range(steps):
            tensordict = policy(tensordict)
            if step % STRIDE == 0:
                frames.append(_frame(tensordict[0], config))
            tensordict = env.step_mdp(env.step(tensordict))
    return frames


def _frame(flock: TensorDictBase, config: FlockingConfig) -> Frame:
    """What is drawn of one flock."""
    position = flock[config.state_key][..., :3].double()
    if (exists := flock.get(("agents", "mask"), None)) is not None:
        position = position.masked_fill(~exists.unsqueeze(-1), torch.nan)
    adjacency = as_matrix(flock["adjacency"].unsqueeze(0), len(position))[0]
    links = (adjacency | adjacency.T).triu(1).nonzero()
    if len(links) > MAX_LINKS:
        length = (position[links[:, 0]] - position[links[:, 1]]).norm(dim=-1)
        links = links[length.topk(MAX_LINKS, largest=False).indices]
    return Frame(*(part.cpu().numpy() for part in (position, flock["agents", "action"].double(), links)))


def write_video(path: str | os.PathLike[str], frames: Sequence[Frame], frequency: float) -> None:
    """Draw frames that `film` made and write them as an mp4 file, whole or not at all.

    Args:
        path: the file; its folder must exist.
        frames: at least one.
        frequency: control steps a second, Hz.

    Raises:
        InputError: a package that it takes is not installed.
    """
    check_video()
    import av

    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    try:
        with av.open(str(temporary), "w") as container:
            stream = container.add_stream(
                "libx264", rate=max(1, round(frequency / STRIDE)), options={"preset": "veryfast"}
            )
            stream.width, stream.height = SIZE
            stream.pix_fmt = "yuv420p"
            for picture in _pictures(frames, frequency):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba")))
            container.mux(stream.encode())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def as_gif(path: str | os.PathLike[str]) -> tuple[bytes, int, int]:
    """An mp4 file as an animated GIF, smaller and of fewer pictures, for what shows no films.

    Returns:
        the GIF, its width and its height, pixels.
    """
    import av

    width, height = GIF_SIZE
    file = io.BytesIO()
    with av.open(str(path)) as source, av.open(file, "w", format="gif") as container:
        rate = source.streams.video[0].average_rate or 24
        stream = container.add_stream("gif", rate=max(1, round(rate / GIF_STRIDE)))
        stream.width, stream.height = width, height
        stream.pix_fmt = "rgb8"
        for number, picture in enumerate(source.decode(video=0)):
            if number % GIF_STRIDE == 0:
                small = picture.to_ndarray(width=width, height=height, format="rgb24")
                container.mux(stream.encode(av.VideoFrame.from_ndarray(small, format="rgb24")))
        container.mux(stream.encode())
    return file.getvalue(), width, height


def _pictures(frames: Sequence[Frame], frequency: float) -> Any:
    """Yield the picture of each frame, uint8 [H, W, 4], good until the next; only what moves is drawn anew."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    centres = [np.nanmean(frame.position, 0) for frame in frames]
    radius = max(1.0, *(np.nanmax(np.abs(frame.position - c)) for frame, c in zip(frames, centres, strict=True)))
    figure = Figure(figsize=(SIZE[0] / DPI, SIZE[1] / DPI), dpi=DPI)
    figure.subplots_adjust(0.06, 0.1, 0.99, 0.94, 0.12)
    canvas = FigureCanvasAgg(figure)
    panels = [_Panel(figure.add_subplot(1, 2, column + 1), name, 1.1 * radius) for column, name in enumerate(VIEWS)]
    clock = panels[0].axes.text(0.02, 0.97, "", transform=panels[0].axes.transAxes, va="top", animated=True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for number, (frame, centre) in enumerate(zip(frames, centres, strict=True)):
        canvas.restore_region(background)
        for panel in panels:
            panel.draw(frame, centre)
        clock.set_text(f"{number * STRIDE / frequency:.1f} s")
        panels[0].axes.draw_artist(clock)
        yield np.asarray(canvas.buffer_rgba())


class _Panel:
    """One view of a flock, about its centre.

    Args:
        axes: where to draw.
        name: of `VIEWS`.
        radius: half the width of what is seen, m.
    """

    def __init__(self, axes: Any, name: str, radius: float) -> None:
        self.axes, self.plane = axes, list(VIEWS[name])
        right, up = (NAMES[axis] for axis in self.plane)
        axes.set(xlim=(-radius, radius), ylim=(-radius, radius), aspect="equal", title=name)
        axes.set(xlabel=f"{right} from the centre, m", ylabel=f"{up} from the centre, m")
        self.artists = [
            axes.plot([], [], style, animated=True, **looks)[0]
            for style, looks in (
                ("-", {"color": "#e3b505", "linewidth": 0.6, "alpha": 0.5}),  # links
                ("-", {"color": "#1f5fbf", "linewidth": 1.2}),  # target velocities
                ("o", {"color": "#14213d", "markersize": 4}),
                ("*", {"color": "#c1292e", "markersize": 12}),
            )
        ]

    def draw(self, frame: Frame, centre: Array) -> None:
        """Draw one frame."""
        position = (frame.position - centre)[:, self.plane]
        targets = position + frame.target_velocity[:, self.plane]
        lines = (_strokes(position[frame.links]), _strokes(np.stack((position, targets), 1)))
        for artist, points in zip(self.artists, (*lines, position[1:], position[:1]), strict=True):
            artist.set_data(*points.T)
            self.axes.draw_artist(artist)


def _strokes(segments: Array) -> Array:
    """Lines [L, 2, 2] as one line [3 L, 2] with gaps, which is drawn much faster than many."""
    return np.pad(segments, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
