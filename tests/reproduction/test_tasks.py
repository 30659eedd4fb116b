"""Cells: kept results, failures that stop nobody else, processes that share the work."""

from __future__ import annotations

import json
import threading

import pytest

from modgnn_rl.reproduction import tasks
from modgnn_rl.reproduction.tasks import Cell, run_cells


def counting(calls, name, result=None, needs=()):
    def work(done):
        calls.append(name)
        return {"value": result, "seen": sorted(done)}

    return Cell(name, work, needs=needs)


def test_needs_come_first_and_hand_over_their_results(tmp_path):
    calls = []
    outcome = run_cells(tmp_path, [counting(calls, "b", 2, ("a",)), counting(calls, "a", 1)])
    assert calls == ["a", "b"]
    assert outcome.results["b"] == {"value": 2, "seen": ["a"]}
    assert not outcome.failures


def test_what_is_done_is_not_done_again(tmp_path):
    calls = []
    work = [counting(calls, "a", 1), counting(calls, "b", 2)]
    first = run_cells(tmp_path, work)
    (tmp_path / "b.json").unlink()
    (tmp_path / "a.json").read_text()
    again = run_cells(tmp_path, work)
    assert calls == ["a", "b", "b"]
    assert again.results == first.results


def test_what_is_gone_is_made_again_where_something_left_needs_it(tmp_path):
    calls = []

    def making(name, needs=()):
        def work(done):
            calls.append(name)
            (tmp_path / f"{name}.made").touch()
            return {"value": name}

        return Cell(name, work, needs=needs, is_there=lambda result: (tmp_path / f"{name}.made").exists())

    work = [making("data"), making("policy", ("data",)), counting(calls, "rollout", 1, ("policy",))]
    first = run_cells(tmp_path, work)
    for file in tmp_path.glob("*.made"):
        file.unlink()
    calls.clear()
    again = run_cells(tmp_path, work)
    assert calls == []
    assert again.results == first.results
    assert again.seconds == first.seconds
    more = run_cells(tmp_path, [*work, counting(calls, "another", 2, ("policy",))])
    assert calls == ["data", "policy", "another"]
    assert more.results.keys() == {"data", "policy", "rollout", "another"}


def test_what_is_made_again_and_not_finished_is_not_done(tmp_path):
    """Else half of it would pass for all of it."""
    calls, made = [], tmp_path / "made"

    def interrupted(done):
        made.touch()
        raise KeyboardInterrupt

    def work(do):
        return [Cell("a", do, is_there=lambda result: made.exists()), counting(calls, "b", 1, ("a",))]

    (tmp_path / "a.json").write_text('{"seconds": 1.0, "result": {}}')
    with pytest.raises(KeyboardInterrupt):
        run_cells(tmp_path, work(interrupted))
    run_cells(tmp_path, work(lambda done: calls.append("a") or {}))
    assert calls == ["a", "b"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"result": 1}', '{"result": {}}'])
def test_a_damaged_result_is_made_again(tmp_path, text):
    calls = []
    (tmp_path / "a.json").write_text(text)
    assert run_cells(tmp_path, [counting(calls, "a", 1)]).results["a"]["value"] == 1
    assert json.loads((tmp_path / "a.json").read_text())["result"]["value"] == 1


def test_a_failure_stops_only_what_needs_it_and_is_tried_again(tmp_path, capsys):
    calls = []

    def fail(done):
        raise RuntimeError("no luck\nat all")

    work = [Cell("a", fail), counting(calls, "b", 1, ("a",)), counting(calls, "c", 1, ("b",)), counting(calls, "d", 2)]
    outcome = run_cells(tmp_path, work)
    assert calls == ["d"]
    assert outcome.failures == {
        "a": "no luck",
        "b": "it needs a, which failed",
        "c": "it needs b, which failed",
    }
    assert outcome.failure_lines() == ["a: no luck", "2 others need what failed"]
    assert "at all" in (tmp_path / "a.failed.txt").read_text()
    assert "a failed: no luck" in capsys.readouterr().err
    mended = run_cells(tmp_path, [counting(calls, "a", 3), *work[1:]])
    assert calls == ["d", "a", "b", "c"]
    assert not mended.failures
    assert not (tmp_path / "a.failed.txt").exists()


def test_interruption_keeps_what_is_done(tmp_path):
    calls = []

    def interrupted(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cells(tmp_path, [counting(calls, "a", 1), Cell("b", interrupted)])
    run_cells(tmp_path, [counting(calls, "a", 1), counting(calls, "b", 2)])
    assert calls == ["a", "b"]


def test_the_time_before_an_interruption_counts(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(tasks.time, "monotonic", lambda: now[0])

    def interrupted(done):
        now[0] += 5.0
        raise KeyboardInterrupt

    def finished(done):
        now[0] += 2.0
        return {}

    with pytest.raises(KeyboardInterrupt):
        run_cells(tmp_path, [Cell("a", interrupted)])
    assert run_cells(tmp_path, [Cell("a", finished)]).seconds["a"] == 7.0
    (tmp_path / "a.json").unlink()
    assert run_cells(tmp_path, [Cell("a", finished)]).seconds["a"] == 2.0


def test_two_that_work_in_one_folder_share_the_cells(tmp_path, monkeypatch):
    monkeypatch.setattr(tasks, "WAIT", 0.01)
    calls, busy = [], threading.Event()
    last = threading.Event()

    def slow(done):
        busy.set()
        last.wait(30)  # until the other has done all the rest
        calls.append("slow")
        return {"value": 0}

    def ending(done):
        calls.append("ending")
        last.set()
        return {"value": 0}

    work = [Cell("slow", slow), Cell("ending", ending), counting(calls, "both", 1, ("slow", "ending"))]
    outcomes = []
    threads = [threading.Thread(target=lambda: outcomes.append(run_cells(tmp_path, work))) for _ in range(2)]
    threads[0].start()
    busy.wait(30)
    threads[1].start()
    for thread in threads:
        thread.join(30)
    assert sorted(calls) == ["both", "ending", "slow"]
    assert outcomes[0].results == outcomes[1].results


def test_progress_tells_the_time_left(tmp_path, capsys, monkeypatch):
    now = iter([0.0, *(10.0 * number for number in range(40))])
    monkeypatch.setattr(tasks.time, "monotonic", lambda: next(now))
    run_cells(tmp_path, [Cell("a", lambda done: {}, cost=1.0), Cell("b", lambda done: {}, cost=3.0)])
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "[1/2]: a"
    assert lines[1].startswith("[2/2, about ")
    assert lines[1].endswith("left]: b")
