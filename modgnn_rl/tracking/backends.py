"""Logger backends: TensorBoard, Weights & Biases and CSV files, on TorchRL's loggers.

They may fail or hang; `modgnn_rl.tracking.loggers.LoggerGroup` guards against both.
"""

from __future__ import annotations

import csv
import os
import shlex
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torchrl.record import CSVLogger, TensorboardLogger, WandbLogger

from modgnn_rl.configs.schema import WandbConfig
from modgnn_rl.configs.settings import flat
from modgnn_rl.errors import one_line
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = ["Backend", "CsvBackend", "TensorboardBackend", "WandbBackend"]

References = Mapping[str, Mapping[str, float]]


class Backend:
    """A logger of a run; what a backend cannot show is left out."""

    logger: Any  # of torchrl.record
    shows_videos = False

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log numbers or tensors of one element."""
        self.logger.log_metrics(dict(metrics), step=step)

    def log_histogram(self, step: int, name: str, values: NDArray[Any]) -> None:
        """Log a histogram of values [n]."""

    def log_video(self, step: int, name: str, path: Path) -> None:
        """Log a video, an mp4 file."""

    def log_table(self, name: str, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
        """Log a table; a later one of the same name replaces it."""

    def log_references(self, step: int, references: References) -> None:
        """Draw horizontal lines up to this step into the charts of metrics.

        Args:
            step: where the lines end.
            references: for each metric, the value of each line by its name.
        """

    def close(self) -> str:
        """Close the logger and return one line that says where its files are."""
        self.logger.close()
        return f"{self.logger.exp_name}: {self.logger.experiment.log_dir}"


class CsvBackend(Backend):
    """A file of steps and values for each metric, a file for each table, and one of the settings.

    Args:
        run: the run; the files lie in ``csv/`` there.
        about: versions and commit, by name.
    """

    def __init__(self, run: RunFolder, about: Mapping[str, str]) -> None:
        self.logger = CSVLogger(exp_name="csv", log_dir=str(run.path))
        self.logger.log_hparams(_shown(run.config, about))

    def log_table(self, name: str, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
        """Write ``csv/tables/<name>.csv``."""
        path = Path(self.logger.experiment.log_dir, "tables", f"{name}.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([columns, *rows])


class TensorboardBackend(Backend):
    """TensorBoard. Each reference is a separate TensorBoard run, so that its lines appear in the charts of the metrics.

    Args:
        run: the run; the files lie in ``tensorboard/`` there, and in a folder of it for each reference.
        about: versions and commit, by name.
    """

    shows_videos = True

    def __init__(self, run: RunFolder, about: Mapping[str, str]) -> None:
        from torch.utils.tensorboard.summary import hparams

        self.logger = TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))
        self.references: dict[str, Any] = {}
        settings = _shown(run.config, about)
        self.log_table("settings", ("setting", "value"), list(settings.items()))
        for summary in hparams(settings, {"error": 0.0}):  # TorchRL's would list the run twice
            self._writer.file_writer.add_summary(summary)

    @property
    def _writer(self) -> Any:
        return self.logger.experiment

    def log_histogram(self, step: int, name: str, values: NDArray[Any]) -> None:
        """Log a histogram of values [n]."""
        self.logger.log_histogram(name, values, step=step, bins="tensorflow")

    def log_video(self, step: int, name: str, path: Path) -> None:
        """Log a video among the images, as a GIF, the only video format that TensorBoard shows."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        from modgnn_rl.visualization.video import as_gif

        gif, width, height = as_gif(path)
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
        self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)

    def log_table(self, name: str, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
        """Log a table among the texts."""
        cells = [columns, ["---"] * len(columns), *rows]
        text = "\n".join("|".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row) for row in cells)
        self._writer.add_text(name, text)

    def log_references(self, step: int, references: References) -> None:
        """Draw horizontal lines up to this step into the charts of metrics."""
        from torch.utils.tensorboard import SummaryWriter

        for metric, values in references.items():
            for name, value in values.items():
                if name not in self.references:
                    self.references[name] = SummaryWriter(os.path.join(self._writer.log_dir, name))
                self.references[name].add_scalar(metric, value, step)

    def close(self) -> str:
        """Close the logger and return one line that says where its files are."""
        for writer in self.references.values():
            writer.close()
        super().close()
        return f"tensorboard --logdir {shlex.quote(self._writer.log_dir)}"


class WandbBackend(Backend):
    """Weights & Biases; asks for no key, and goes offline where the server cannot be reached.

    Args:
        run: the run; the files lie in ``wandb/`` there.
        about: versions and commit, by name.
        config: where to send it, and whether.
    """

    shows_videos = True

    def __init__(self, run: RunFolder, about: Mapping[str, str], config: WandbConfig) -> None:
        self.run, self.about, self.config = run, dict(about), config
        try:
            self.logger = self._start(config.mode)
        except Exception as error:  # no key, no network, no such project: all mean offline
            if config.mode != "online":
                raise
            warnings.warn(
                f"Weights & Biases cannot be reached ({one_line(error)}); this run is logged offline",
                RuntimeWarning,
                stacklevel=2,
            )
            self.logger = self._start("offline")

    def _start(self, mode: str) -> Any:
        """Start a Weights & Biases run in exactly this mode."""
        # Its error reports, on unless refused, hold back the exit for 20 s where the server does not answer.
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        # It keeps a log of its own in the home folder otherwise, and floods the terminal where that is read-only.
        os.environ.setdefault("WANDB_CACHE_DIR", str(self.run.path / "wandb" / "cache"))
        import wandb

        wandb.setup(wandb.Settings(silent=True))
        # Asked before init, which would prompt on a terminal where there is no key.
        if mode == "online" and not wandb.login(prompt=False, verify=False):
            raise RuntimeError("no API key; `wandb login` stores one")
        settings = wandb.Settings(
            console="off",
            init_timeout=self.config.init_timeout,
            finish_timeout=self.config.init_timeout,
            finish_timeout_raises=True,
            x_save_requirements=False,  # the list of all installed packages is nobody's business
        )
        # The mode goes to wandb.init: TorchRL's own `offline=True` would set WANDB_MODE for the whole process.
        return WandbLogger(
            exp_name=self.run.path.name,
            save_dir=str(self.run.path),
            project=self.config.project,
            log_env_packages=False,
            entity=self.config.entity,
            group=self.config.group,
            mode=mode,
            reinit="create_new",
            config={**self.run.config, "made_with": self.about},
            settings=settings,
        )

    def log_histogram(self, step: int, name: str, values: NDArray[Any]) -> None:
        """Log a histogram of values [n]."""
        self.logger.log_histogram(name, values, step=step, bins=64)

    def log_video(self, step: int, name: str, path: Path) -> None:
        """Log a video, an mp4 file."""
        import wandb

        self.logger.log_metrics({name: wandb.Video(str(path), format="mp4")}, step=step)

    def log_table(self, name: str, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
        """Log a table; a later one of the same name replaces it."""
        import wandb

        self.logger.experiment.log({name: wandb.Table(columns=list(columns), data=[list(row) for row in rows])})

    def log_references(self, step: int, references: References) -> None:
        """Draw charts of metrics, as they are in ``metrics.jsonl``, with horizontal lines; its own charts hold none."""
        import wandb

        records = [record for record in self.run.read_metrics() if record["step"] <= step]
        charts = {}
        for metric, values in references.items():
            points = [(r["step"], r[metric]) for r in records if np.isfinite(r.get(metric, np.nan))]
            if points:
                steps, own = zip(*points, strict=True)
                ends = [min(0, steps[0]), step]
                charts[f"references/{metric}"] = wandb.plot.line_series(
                    xs=[steps, *[ends] * len(values)],
                    ys=[own, *([value] * 2 for value in values.values())],
                    keys=["this run", *values],
                    title=f"{metric}, and that of others",
                    xname="step",
                )
        self.logger.experiment.log(charts)

    def close(self) -> str:
        """Finish, and return one line for the user that says where it all lies, and how to send it."""
        settings, url = self.logger.experiment.settings, self.logger.experiment.url
        send = f"to send it: wandb sync {shlex.quote(settings.sync_dir)}"
        try:
            self.logger.close()
        except TimeoutError:
            return f"wandb: {url}, not all of which could be sent; {send}"
        if settings.mode == "disabled":
            return "wandb: disabled, nothing was kept"
        return f"wandb: {url}" if settings.mode == "online" else f"wandb: offline run in {settings.sync_dir}; {send}"


def _shown(config: Mapping[str, Any], about: Mapping[str, str]) -> dict[str, str | float]:
    """Settings, and what a run was made with, by their dotted names; what is no number is a text."""
    leaves = flat({**config, "made_with": about})
    return {key: value if isinstance(value, (bool, int, float)) else str(value) for key, value in leaves.items()}
