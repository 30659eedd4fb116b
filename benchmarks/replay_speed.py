"""Frames per second of a replay played in real time in a headless Chromium with software rendering.

``python benchmarks/replay_speed.py <replay.html> [<another.html> ...]``
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
browser = importlib.import_module("browser")

SECONDS = 5
COUNT = f"""new Promise((done) => {{
  const drawn = state.drawn, begun = performance.now();
  const speed = () => (state.drawn - drawn) / (performance.now() - begun);
  setTimeout(() => done(1000 * speed()), 1000 * Math.min({SECONDS}, 0.9 * LAST));
}})"""


def main() -> None:
    """Print size and speed of each page, with two rollouts and with one."""
    if browser.CHROMIUM is None or not sys.argv[1:]:
        sys.exit(f"{__doc__}\nIt needs a Chromium on the PATH.")
    for page in map(Path, sys.argv[1:]):
        with browser.Browser(1280, 800) as window:
            window.open(page.resolve().as_uri())
            window.wait("state.drawn > 1")
            speeds = []
            for both in window.run("content.rollouts.length > 1 ? [true, false] : [false]"):
                window.run(f"if (state.both !== {str(both).lower()}) toggle('both'); goTo(0); play(true)")
                speeds.append(f"{window.run(COUNT):.0f} frames/s {'side by side' if both else 'alone'}")
            what = window.run("`${N} agents, ${T} frames`")
        print(f"{page}: {what}, {page.stat().st_size / 1e6:.2f} MB, {', '.join(speeds)}", flush=True)


if __name__ == "__main__":
    main()
