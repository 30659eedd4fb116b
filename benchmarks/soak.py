"""Hours of training with random failures: ``python benchmarks/soak.py --hours 2``.

At random moments a training run is killed, interrupted or halted, its disk is full, the helper process of its dashboard
is killed, or its newest checkpoint is damaged; whenever it ends it is resumed. In the end this prints how often each
failure happened, and whether memory grew, a line of metrics was missing or duplicated, or a file or process was left
behind; the exit code is 1 in that case. Linux only: it reads ``/proc``.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

ENDLESS = 1_000_000
SETTINGS = [
    "trainer=dagger",
    f"trainer.rounds={ENDLESS}",
    "trainer.num_envs=4",
    "trainer.capacity=4000",
    "trainer.cloning_updates=40",
    "trainer.updates_per_round=20",
    "trainer.checkpoint_minutes=0.1",
    "env.num_agents=16",
    "threads=1",
    "logger=[csv,tensorboard,wandb]",
    "wandb.mode=offline",
]
PAGE = resource.getpagesize()


class Soak:
    """One training run, resumed whenever it ends.

    Args:
        folder: for the run and its temporary files, otherwise empty.
        moments: source of the failures and of their times.
    """

    def __init__(self, folder: Path, moments: random.Random) -> None:
        self.folder, self.moments = folder, moments
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        self.failures: Counter[str] = Counter()
        self.complaints: list[str] = []
        self.lives: list[list[tuple[float, float]]] = []  # of each process: seconds alive, megabytes resident
        self.process = self._start()

    @property
    def run(self) -> Path:
        """The run folder."""
        (run,) = (self.folder / "runs").iterdir()
        return run

    def live(self, seconds: float) -> None:
        """Let the run train, and record its memory."""
        until = time.monotonic() + seconds
        while time.monotonic() < until and self.process.poll() is None:
            pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
            self.lives[-1].append((time.monotonic() - self.began, pages * PAGE / 2**20))
            time.sleep(min(5.0, max(until - time.monotonic(), 0.01)))

    def fail(self) -> None:
        """Cause one failure; if it ended the run, resume it."""
        ending = [self.kill, self.kill_while_writing, self.stop, self.interrupt, self.damage]
        failure: Callable[[], None] = self.moments.choice([*ending, self.halt, self.fill_disk, self.kill_dashboard])
        self.failures[failure.__name__] += 1
        failure()
        if self.process.poll() is not None:
            self._check_left_behind()
            self.process = self._start("resume=" + str(self.run))

    def kill(self) -> None:
        """End it with SIGKILL."""
        self._end(signal.SIGKILL, -signal.SIGKILL)

    def kill_while_writing(self) -> None:
        """End it with SIGKILL as soon as a checkpoint is being written."""
        until = time.monotonic() + 60
        while not list((self.run / "checkpoints").glob("*.tmp")) and time.monotonic() < until:
            time.sleep(0.002)
        self.kill()

    def stop(self) -> None:
        """SIGTERM."""
        self._end(signal.SIGTERM, 143)

    def interrupt(self) -> None:
        """Ctrl-C."""
        self._end(signal.SIGINT, 130)

    def damage(self) -> None:
        """End it with SIGKILL, and flip one bit in the newest checkpoint."""
        self.kill()
        newest = max((self.run / "checkpoints").glob("step_*[0-9]"), key=lambda path: path.stat().st_mtime)
        file = self.moments.choice(sorted(newest.iterdir()))
        content = bytearray(file.read_bytes())
        content[self.moments.randrange(len(content))] ^= 1
        file.write_bytes(content)

    def halt(self) -> None:
        """Stop the process for a while, as on a machine that sleeps."""
        self.process.send_signal(signal.SIGSTOP)
        time.sleep(20)
        self.process.send_signal(signal.SIGCONT)

    def fill_disk(self) -> None:
        """Limit files to 20 kB for half a minute."""
        unlimited = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
        self.live(30)
        if self.process.poll() is None:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, unlimited)
        else:
            self.complaints.append(f"a full disk ended the run with code {self.process.returncode}")

    def kill_dashboard(self) -> None:
        """Kill the helper process of the dashboard."""
        for pid in self._others():
            os.kill(pid, signal.SIGKILL)

    def finish(self) -> None:
        """Stop the run and check what it left."""
        self.stop()
        self._check_left_behind()
        if left := list(self.run.rglob("*.tmp*")):
            self.complaints.append(f"{len(left)} temporary files left in the run folder, such as {left[0]}")
        lines = (self.run / "metrics.jsonl").read_text().splitlines()
        rounds = [json.loads(line)["step"] for line in lines]
        if rounds != sorted(set(rounds)):
            self.complaints.append("metrics.jsonl has lines twice or out of order")
        print(f"{len(lines)} lines of metrics, to round {rounds[-1]}")
        kept = sorted(path.name for path in (self.run / "checkpoints").iterdir() if path.is_dir())
        print(f"checkpoints: {', '.join(kept)}")

    def memory(self) -> str:
        """Growth of memory in the longest life, from when the replay buffer is full."""
        longest = max(self.lives, key=len)
        seconds, megabytes = np.array(longest[len(longest) // 3 :]).T
        slope = np.polyfit(seconds / 3600, megabytes, 1)[0]
        lives = [np.median([size for _, size in life[len(life) // 2 :]]) for life in self.lives if len(life) > 20]
        last = ", ".join(f"{value:.0f}" for value in lives)
        return f"longest life {seconds[-1]:.0f} s: {slope:+.1f} MB/h; medians of the lives, MB: {last}"

    def _start(self, *settings: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "TMPDIR": str(self.temporary)}
        command = [sys.executable, "-m", "modgnn_rl.train", *(settings or (*SETTINGS, f"runs={self.folder / 'runs'}"))]
        self.began = time.monotonic()
        self.lives.append([])
        with (self.folder / "terminal.txt").open("ab") as terminal:
            return subprocess.Popen(
                command,
                stdout=terminal,
                stderr=terminal,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )

    def _end(self, kind: int, code: int) -> None:
        self.process.send_signal(kind)
        try:
            ended = self.process.wait(timeout=120)
        except subprocess.TimeoutExpired:
            self.complaints.append(f"signal {kind} did not end the run within two minutes")
            self.process.kill()
            self.process.wait()
            return
        if ended not in (code, -kind):  # which a shell shows alike; the second before the run listens to signals
            self.complaints.append(f"signal {kind} ended the run with code {ended}, not {code}")

    def _others(self) -> list[int]:
        """The processes that the run started: those of its session."""
        found = subprocess.run(["ps", "-s", str(self.process.pid), "-o", "pid="], capture_output=True, text=True)
        return [pid for pid in map(int, found.stdout.split()) if pid != self.process.pid]

    def _check_left_behind(self) -> None:
        until = time.monotonic() + 30
        while self._others() and time.monotonic() < until:
            time.sleep(0.5)
        for pid in self._others():
            self.complaints.append(f"process {pid} outlived its run by half a minute")
            os.kill(pid, signal.SIGKILL)
        left = [path for path in self.temporary.rglob("*") if path.is_file()]
        if left and self.process.returncode > 0:  # a killed process cannot tidy up
            self.complaints.append(f"{len(left)} temporary files left, such as {left[0]}")
        shutil.rmtree(self.temporary, ignore_errors=True)  # a socket may disappear just now
        self.temporary.mkdir(exist_ok=True)


def main() -> None:
    """Soak, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0, help="of the failures")
    parser.add_argument("--pause", type=float, default=150.0, help="mean time between two failures (s)")
    options = parser.parse_args()
    moments = random.Random(options.seed)
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    soak = Soak(folder, moments)
    until = time.monotonic() + 3600 * options.hours
    try:
        soak.live(60)  # a first checkpoint
        while time.monotonic() < until:
            soak.live(moments.expovariate(1 / options.pause))
            soak.fail()
            print(f"{(until - time.monotonic()) / 60:.0f} min left, failures: {dict(soak.failures)}", flush=True)
        soak.live(60)
        soak.finish()
    finally:
        if soak.process.poll() is None:
            soak.process.kill()
    print(soak.memory())
    print("\n".join(soak.complaints) or "nothing left behind, nothing missing")
    if soak.complaints:
        sys.exit(f"the run is in {folder}")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
