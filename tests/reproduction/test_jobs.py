"""Jobs: stored results, isolated failures, processes that share the work."""

from __future__ import annotations

import threading

import pytest

from modgnn_rl.reproduction import jobs
from modgnn_rl.reproduction.jobs import Job, run_jobs
from modgnn_rl.reproduction.store import ResultStore


def counting(calls, name, result=None, depends_on=()):
    def work(done):
        calls.append(name)
        return {"value": result, "seen": sorted(done)}

    return Job(name, work, depends_on=depends_on)


def test_dependencies_run_first_and_pass_on_their_results(tmp_path):
    calls = []
    outcome = run_jobs(tmp_path, [counting(calls, "b", 2, ("a",)), counting(calls, "a", 1)])
    assert calls == ["a", "b"]
    assert outcome.results["b"] == {"value": 2, "seen": ["a"]}
    assert not outcome.failures


def test_finished_jobs_do_not_run_again(tmp_path):
    calls = []
    work = [counting(calls, "a", 1), counting(calls, "b", 2)]
    first = run_jobs(tmp_path, work)
    ResultStore(tmp_path).write("results", "b", None)
    again = run_jobs(tmp_path, work)
    assert calls == ["a", "b", "b"]
    assert again.results == first.results


def test_deleted_files_are_recomputed_if_a_pending_job_needs_them(tmp_path):
    calls = []

    def making(name, depends_on=()):
        def work(done):
            calls.append(name)
            (tmp_path / f"{name}.made").touch()
            return {"value": name}

        return Job(name, work, depends_on=depends_on, is_valid=lambda result: (tmp_path / f"{name}.made").exists())

    work = [making("data"), making("policy", ("data",)), counting(calls, "rollout", 1, ("policy",))]
    first = run_jobs(tmp_path, work)
    for file in tmp_path.glob("*.made"):
        file.unlink()
    calls.clear()
    again = run_jobs(tmp_path, work)
    assert calls == []
    assert again.results == first.results
    assert again.seconds == first.seconds
    more = run_jobs(tmp_path, [*work, counting(calls, "another", 2, ("policy",))])
    assert calls == ["data", "policy", "another"]
    assert more.results.keys() == {"data", "policy", "rollout", "another"}


def test_an_interrupted_recomputation_is_not_finished(tmp_path):
    """Else half of it would pass for all of it."""
    calls, made = [], tmp_path / "made"

    def interrupted(done):
        made.touch()
        raise KeyboardInterrupt

    def work(do):
        return [Job("a", do, is_valid=lambda result: made.exists()), counting(calls, "b", 1, ("a",))]

    ResultStore(tmp_path).write("results", "a", {"seconds": 1.0, "result": {}})
    with pytest.raises(KeyboardInterrupt):
        run_jobs(tmp_path, work(interrupted))
    run_jobs(tmp_path, work(lambda done: calls.append("a") or {}))
    assert calls == ["a", "b"]


@pytest.mark.parametrize(
    "line", ["", "{", "[]", '{"job": "a", "result": 1}', '{"job": "a", "result": {}}', '{"job": "a", "sec']
)
def test_a_damaged_result_is_recomputed(tmp_path, line):
    calls = []
    whole = '{"job": "b", "seconds": 2.0, "result": {"value": 3}}'
    (tmp_path / "results.jsonl").write_text(f"{line}\n{whole}\n")
    assert run_jobs(tmp_path, [counting(calls, "a", 1)]).results["a"]["value"] == 1
    stored = ResultStore(tmp_path).read("results")
    assert {name: entry["result"]["value"] for name, entry in stored.items()} == {"a": 1, "b": 3}


def test_a_failure_blocks_only_its_dependents_and_is_tried_again(tmp_path, capsys):
    calls = []

    def fail(done):
        raise RuntimeError("no luck\nat all")

    work = [Job("a", fail), counting(calls, "b", 1, ("a",)), counting(calls, "c", 1, ("b",)), counting(calls, "d", 2)]
    outcome = run_jobs(tmp_path, work)
    assert calls == ["d"]
    assert outcome.failures == {
        "a": "no luck",
        "b": "it depends on a, which failed",
        "c": "it depends on b, which failed",
    }
    assert outcome.failure_lines() == ["a: no luck", "2 others depend on failed jobs"]
    assert "at all" in (tmp_path / "a.failed.txt").read_text()
    assert "a failed: no luck" in capsys.readouterr().err
    mended = run_jobs(tmp_path, [counting(calls, "a", 3), *work[1:]])
    assert calls == ["d", "a", "b", "c"]
    assert not mended.failures
    assert not (tmp_path / "a.failed.txt").exists()


def test_interruption_keeps_finished_jobs(tmp_path):
    calls = []

    def interrupted(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_jobs(tmp_path, [counting(calls, "a", 1), Job("b", interrupted)])
    run_jobs(tmp_path, [counting(calls, "a", 1), counting(calls, "b", 2)])
    assert calls == ["a", "b"]


def test_the_time_before_an_interruption_counts(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(jobs.time, "monotonic", lambda: now[0])

    def interrupted(done):
        now[0] += 5.0
        raise KeyboardInterrupt

    def finished(done):
        now[0] += 2.0
        return {}

    with pytest.raises(KeyboardInterrupt):
        run_jobs(tmp_path, [Job("a", interrupted)])
    assert run_jobs(tmp_path, [Job("a", finished)]).seconds["a"] == 7.0
    ResultStore(tmp_path).write("results", "a", None)
    assert run_jobs(tmp_path, [Job("a", finished)]).seconds["a"] == 2.0


def test_two_processes_in_one_folder_share_the_jobs(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "POLL", 0.01)
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

    work = [Job("slow", slow), Job("ending", ending), counting(calls, "both", 1, ("slow", "ending"))]
    outcomes = []
    threads = [threading.Thread(target=lambda: outcomes.append(run_jobs(tmp_path, work))) for _ in range(2)]
    threads[0].start()
    busy.wait(30)
    threads[1].start()
    for thread in threads:
        thread.join(30)
    assert sorted(calls) == ["both", "ending", "slow"]
    assert outcomes[0].results == outcomes[1].results


def test_progress_shows_the_time_left(tmp_path, capsys, monkeypatch):
    now = iter([0.0, *(10.0 * number for number in range(40))])
    monkeypatch.setattr(jobs.time, "monotonic", lambda: next(now))
    run_jobs(tmp_path, [Job("a", lambda done: {}, cost=1.0), Job("b", lambda done: {}, cost=3.0)])
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "[1/2]: a"
    assert lines[1].startswith("[2/2, about ")
    assert lines[1].endswith("left]: b")


def test_a_group_of_jobs_is_one_file(tmp_path):
    jobs_of_groups = [Job(name, lambda done: {}, group=group) for name, group in (("a", "x"), ("b", "x"), ("c", "y"))]
    run_jobs(tmp_path, jobs_of_groups)
    assert sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith(".")) == ["x.jsonl", "y.jsonl"]
    assert list(ResultStore(tmp_path).read("x")) == ["a", "b"]


def test_processes_that_store_at_the_same_time_lose_nothing(tmp_path):
    def store(first):
        for number in range(first, first + 20):
            ResultStore(tmp_path).write("results", str(number), {"seconds": 0.0, "result": {}})

    threads = [threading.Thread(target=store, args=(first,)) for first in (0, 20, 40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(ResultStore(tmp_path).read("results")) == {str(number) for number in range(60)}
