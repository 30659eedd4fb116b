"""Videos of recorded rollouts, from above and from the side."""

from __future__ import annotations

import importlib.util
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.errors import InputError
from modgnn_rl.visualization.recording import QUANTUM, Frame, Recording, shortest_edges

__all__ = ["VIDEO_STRIDE", "as_gif", "check_video", "write_video"]

Array = NDArray[Any]

SIZE = (800, 400)  # pixels
DPI = 72
VIDEO_STRIDE = 2  # usual stride of recordings for videos
MAX_EDGES = 2000  # the shortest are drawn
GIF_SIZE = (600, 300)  # pixels
GIF_STRIDE = 3  # video frames from one GIF frame to the next
VIEWS = {"from above": (0, 1), "from the side": (0, 2)}
AXES = "xyz"


def check_video() -> None:
    """Check that videos can be written.

    Raises:
        InputError: a required package is not installed.
    """
    missing = [name for name in ("av", "matplotlib") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"videos need packages that are not installed: pip install {' '.join(missing)}")


def write_video(path: str | os.PathLike[str], recording: Recording) -> None:
    """Draw the frames of a recording and write them as an mp4 file, atomically.

    Args:
        path: the file; its folder must exist.
        recording: its stride and frequency set the frame rate.

    Raises:
        InputError: a required package is not installed.
    """
    check_video()
    import av

    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    try:
        with av.open(str(temporary), "w") as container:
            rate = max(1, round(1 / recording.period))
            stream = container.add_stream("libx264", rate=rate, options={"preset": "veryfast"})
            stream.width, stream.height = SIZE
            stream.pix_fmt = "yuv420p"
            for image in _images(recording):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgba")))
            container.mux(stream.encode())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def as_gif(path: str | os.PathLike[str]) -> tuple[bytes, int, int]:
    """Convert an mp4 file to a smaller animated GIF with fewer frames, for loggers that cannot show videos.

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
        for number, frame in enumerate(source.decode(video=0)):
            if number % GIF_STRIDE == 0:
                small = frame.to_ndarray(width=width, height=height, format="rgb24")
                container.mux(stream.encode(av.VideoFrame.from_ndarray(small, format="rgb24")))
        container.mux(stream.encode())
    return file.getvalue(), width, height


def _images(recording: Recording) -> Iterator[Array]:
    """Yield the image of each frame, uint8 [H, W, 4], valid until the next; only moving parts are redrawn."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    position = np.where(recording.present[..., None], recording.position * QUANTUM, np.nan)
    centres = np.nanmean(position, 1)
    radius = max(1.0, float(np.nanmax(np.abs(position - centres[:, None]))))
    figure = Figure(figsize=(SIZE[0] / DPI, SIZE[1] / DPI), dpi=DPI)
    figure.subplots_adjust(0.06, 0.1, 0.99, 0.94, 0.12)
    canvas = FigureCanvasAgg(figure)
    views = list(VIEWS)[: 1 if recording.dims < 3 else None]
    panels = [
        _Panel(figure.add_subplot(1, len(views), column + 1), name, 1.1 * radius) for column, name in enumerate(views)
    ]
    clock = panels[0].axes.text(0.02, 0.97, "", transform=panels[0].axes.transAxes, va="top", animated=True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for index in range(len(recording)):
        frame = recording.frame(index)
        frame = frame._replace(position=position[index] - centres[index], marks=frame.marks - centres[index])
        canvas.restore_region(background)
        for panel in panels:
            panel.draw(frame)
        clock.set_text(f"{index * recording.period:.1f} s")
        panels[0].axes.draw_artist(clock)
        yield np.asarray(canvas.buffer_rgba())


class _Panel:
    """One view of a flock, around its centre.

    Args:
        axes: matplotlib axes.
        name: one of `VIEWS`.
        radius: half the width of the view, m.
    """

    def __init__(self, axes: Any, name: str, radius: float) -> None:
        self.axes, self.plane = axes, list(VIEWS[name])
        right, up = (AXES[axis] for axis in self.plane)
        axes.set(xlim=(-radius, radius), ylim=(-radius, radius), aspect="equal", title=name)
        axes.set(xlabel=f"{right} from the centre, m", ylabel=f"{up} from the centre, m")
        self.artists = [
            axes.plot([], [], style, animated=True, **looks)[0]
            for style, looks in (
                ("-", {"color": "#e3b505", "linewidth": 0.6, "alpha": 0.5}),  # edges
                ("-", {"color": "#1f5fbf", "linewidth": 1.2}),  # arrows
                ("o", {"color": "#14213d", "markersize": 4}),  # agents
                ("*", {"color": "#c1292e", "markersize": 12}),  # leader
                ("+", {"color": "#c1292e", "markersize": 9}),  # marks
            )
        ]

    def draw(self, frame: Frame) -> None:
        """Draw one frame."""
        position = frame.position[:, self.plane]
        tips = position + frame.arrow[:, self.plane]
        leads = np.arange(len(position)) == (-1 if frame.leader is None else frame.leader)
        edges = position[shortest_edges(frame, MAX_EDGES)]
        lines = (_strokes(edges), _strokes(np.stack((position, tips), 1)))
        for artist, points in zip(
            self.artists, (*lines, position[~leads], position[leads], frame.marks[:, self.plane]), strict=True
        ):
            artist.set_data(*points.T)
            self.axes.draw_artist(artist)


def _strokes(segments: Array) -> Array:
    """Lines [L, 2, 2] as one line [3 L, 2] with gaps, which is drawn much faster than many lines."""
    return np.pad(segments, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
