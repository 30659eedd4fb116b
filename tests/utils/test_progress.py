"""The progress display, on a false terminal and in a false file, by a false clock."""

from __future__ import annotations

import io
import math

import pytest

from modgnn_rl.utils.progress import Progress


class Terminal(io.StringIO):
    """Says that it is a terminal."""

    def isatty(self):
        """Say so."""
        return True


class Clock:
    """Stands still until it is set."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        """Return the time in s."""
        return self.now


def test_plain_lines_are_rare_and_complete():
    stream, clock = io.StringIO(), Clock()
    with Progress("dagger", 4000, stream=stream, every=10.0, clock=clock) as progress:
        for number in range(1, 31):
            clock.now += 1.0
            progress.update(100, round=f"{number}/40", error=0.12345)
    first, second, third, last = stream.getvalue().splitlines()
    assert first == "dagger:  25% 1.00k/4.00k, round 10/40, error 0.123 [100 flock-steps/s, 00:10 elapsed, 00:30 left]"
    assert "2.00k/4.00k, round 20/40" in second
    assert "3.00k/4.00k, round 30/40" in third
    assert "00:30 elapsed, 00:10 left" in last


def test_a_short_run_has_a_final_line_only():
    stream = io.StringIO()
    with Progress("evaluate", 10, unit="rollouts", stream=stream, clock=Clock()) as progress:
        progress.update(4, row="expert")
        progress.update(6, error=1e-5)
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("evaluate: 100% 10.0/10.0, row expert, error 1e-05 [")
    assert (progress.done, progress.total) == (10, 10)


def test_a_value_that_is_nan_is_not_shown():
    stream = io.StringIO()
    with Progress("dagger", 2, stream=stream, every=0.0, clock=Clock()) as progress:
        progress.update(1, round="0/1", error=math.nan)
        progress.update(1, round="1/1", error=0.5)
    first, second, _ = stream.getvalue().splitlines()
    assert "round 0/1 [" in first
    assert "round 1/1, error 0.5 [" in second


def test_a_terminal_has_one_live_line():
    stream = Terminal()
    with Progress("dagger", 200, stream=stream) as progress:
        progress.update(50, round="1/4", error=0.5)
        progress.update(150, round="4/4", error=0.25)
    text = stream.getvalue()
    assert text.count("\n") == 1
    assert text.endswith("\n")
    last = text.strip().split("\r")[-1]
    assert last.startswith("dagger: 100%|")
    for part in ("200/200", "round 4/4", "error 0.25", "flock-steps/s", "left"):
        assert part in last


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()])
def test_an_exception_is_passed_on_after_the_final_line(stream):
    def diverge():
        with Progress("dagger", 10, stream=stream) as progress:
            progress.update(1)
            raise RuntimeError("diverged")

    with pytest.raises(RuntimeError, match="diverged"):
        diverge()
    assert stream.getvalue().endswith("\n")


def test_the_standard_error_stream_is_the_default(capsys):
    with Progress("dagger", 10) as progress:
        progress.update(10)
    out, err = capsys.readouterr()
    assert out == ""
    assert "dagger: 100%" in err


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), BrokenPipeError(32, "Broken pipe")])
def test_an_unwritable_stream_does_not_end_the_work(error):
    class Full(io.StringIO):
        def write(self, text):
            raise error

    with Progress("dagger", 4, stream=Full(), every=0.0) as progress:
        progress.update(4)
    assert progress.done == 4
