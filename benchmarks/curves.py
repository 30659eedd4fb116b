"""Plot metrics of runs over their rounds: ``python benchmarks/curves.py curves.png 32/error runs/a runs/b ...``.

Runs with the same label, ``runs/a=label``, or whose names differ only in ``-seed<n>`` or a trailing number, share a
line (their mean) and a band (minimum to maximum). Needs the extra ``plots``.
"""

from __future__ import annotations

import argparse
import re
from collections import defaultdict

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

from modgnn_rl.tracking.run_folder import RunFolder


def smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Running mean over ``width`` rounds, fewer at the ends; NaN does not count."""
    known = np.isfinite(values)
    kernel = np.ones(width)
    total = np.convolve(np.where(known, values, 0.0), kernel, "same")
    count = np.convolve(known, kernel, "same")
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def group_of(run: RunFolder) -> str:
    """The name of a run without its date and seed."""
    name = re.sub(r"^\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-", "", run.path.name)
    return re.sub(r"(-seed)?\d+$", "", name) or name


def main() -> None:
    """Read the runs and plot one panel per metric."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file to write: PNG, SVG or PDF")
    parser.add_argument("metrics", help="names in metrics.jsonl, separated by commas")
    parser.add_argument("runs", nargs="+", help="run folders")
    parser.add_argument("--width", type=int, default=9, help="rounds to average over")
    parser.add_argument("--log", action="store_true", help="logarithmic scale")
    parser.add_argument("--line", action="append", default=[], help="metric=value=label: a horizontal line")
    options = parser.parse_args()
    groups: dict[str, list[list[dict[str, float]]]] = defaultdict(list)
    for path in options.runs:
        folder, _, label = path.partition("=")
        run = RunFolder.open(folder)
        groups[label or group_of(run)].append(run.read_metrics())
    names = options.metrics.split(",")
    figure, axes = plt.subplots(1, len(names), figsize=(4.4 * len(names), 3.2), squeeze=False, layout="constrained")
    for axis, name in zip(axes[0], names, strict=True):
        for index, records in enumerate(groups.values()):
            curves = [[(r["step"], r[name]) for r in lines if name in r and r["step"] > 0] for lines in records]
            length = min(map(len, curves))
            if not length:
                continue
            steps = np.array([step for step, _ in curves[0][:length]])
            values = np.array([smooth(np.array([v for _, v in curve]), options.width)[:length] for curve in curves])
            axis.plot(steps, values.mean(0), color=f"C{index}")
            axis.fill_between(steps, values.min(0), values.max(0), color=f"C{index}", alpha=0.2, linewidth=0)
        for entry in options.line:
            metric, value, label = entry.split("=")
            if metric == name:
                axis.axhline(float(value), linestyle="--", color="gray", linewidth=1)
                axis.annotate(label, (0.99, float(value)), xycoords=("axes fraction", "data"), ha="right", va="bottom")
        axis.set(xlabel="round", title=name, yscale="log" if options.log else "linear")
        axis.grid(alpha=0.3)
    labels = [f"{group} ({len(records)})" if len(records) > 1 else group for group, records in groups.items()]
    lines = [Line2D([], [], color=f"C{index}") for index in range(len(labels))]
    figure.legend(lines, labels, loc="outside right upper", fontsize="small")
    figure.savefig(options.picture, dpi=140)
    print(f"Wrote {options.picture}")


if __name__ == "__main__":
    main()
