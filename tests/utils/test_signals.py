"""The first signal lets a step finish, the second ends the process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from modgnn_rl.utils.signals import GracefulInterrupt, Stopped

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


@pytest.mark.parametrize("number", CODES)
def test_a_signal_waits_for_the_check(number, capfd):
    done = []

    def work():
        with GracefulInterrupt().listen() as interruption, interruption.deferred("Stopping soon."):
            os.kill(os.getpid(), number)
            done.append("the step")
            assert interruption.is_requested
            interruption.check()
            done.append("too much")

    with pytest.raises(Stopped) as stopped:
        work()
    assert done == ["the step"]
    assert stopped.value.code == CODES[number]
    assert "Stopping soon." in capfd.readouterr().err


@pytest.mark.parametrize("number", CODES)
def test_a_signal_outside_deferred_stops_at_once(number):
    done = []

    def work():
        with GracefulInterrupt().listen():
            os.kill(os.getpid(), number)
            done.append("too much")

    with pytest.raises(Stopped):
        work()
    assert not done


def test_previous_handlers_are_restored():
    before = [signal.getsignal(number) for number in CODES]
    with GracefulInterrupt().listen() as interruption:
        assert signal.getsignal(signal.SIGTERM) != before[1]
        assert not interruption.is_requested
        interruption.check()
    assert [signal.getsignal(number) for number in CODES] == before


def test_signals_are_not_handled_outside_the_main_thread():
    before, heard = signal.getsignal(signal.SIGTERM), []

    def work():
        with GracefulInterrupt().listen():
            heard.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert heard == [before]


@pytest.mark.parametrize("number", CODES)
def test_a_second_signal_ends_the_process_at_once(number):
    program = f"""
import os, time
from modgnn_rl.utils.signals import GracefulInterrupt
with GracefulInterrupt().listen() as interruption:
    with interruption.deferred("Stopping soon."):
        try:
            for _ in range(2):
                os.kill(os.getpid(), {int(number)})
        finally:
            time.sleep(600)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == CODES[number]
    assert ended.stderr.strip() == "Stopping soon."
