"""The run folder: made whole or not at all, readable while and after it is written."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from modgnn_rl.errors import InputError
from modgnn_rl.tracking import run_folder
from modgnn_rl.tracking.run_folder import RunFolder

CONFIG = "env:\n  comm_range: 3.5\n  num_agents: [8, 16]\nlr: 1.0e-05\nname: null\n"


def test_create_and_open_agree(tmp_path):
    made = RunFolder.create(tmp_path / "runs", "dagger", CONFIG)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-dagger", made.path.name)
    assert made.config == {"env": {"comm_range": 3.5, "num_agents": [8, 16]}, "lr": 1e-5, "name": None}
    assert RunFolder.open(made.path) == made
    text = (made.path / "config.yaml").read_text()
    assert text.startswith("#")
    assert text.splitlines()[1] == "schema_version: 2"
    assert text.endswith(CONFIG)


def test_runs_of_one_second_get_folders_of_their_own(tmp_path):
    paths = [RunFolder.create(tmp_path, "dagger", "seed: 0\n").path for _ in range(4)]
    assert len(set(paths)) == 4


def test_open_keeps_pointing_at_the_folder_from_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = RunFolder.create("runs", "dagger", "seed: 0\n")
    monkeypatch.chdir("/")
    run.log(1, {"error": 0.5})
    assert run.read_metrics() == [{"step": 1, "error": 0.5}]


@pytest.mark.parametrize("name", ["", "a/b", "..", "-rf", "a b", "a\n"])
def test_a_name_that_is_no_folder_name_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="cannot name a folder"):
        RunFolder.create(tmp_path / "runs", name, "")
    assert list(tmp_path.iterdir()) == []


def test_a_root_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "runs").write_text("mine")
    with pytest.raises(InputError, match=r"cannot write into .*choose"):
        RunFolder.create(tmp_path / "runs", "dagger", "")
    assert (tmp_path / "runs").read_text() == "mine"


@pytest.mark.parametrize("root_exists", [True, False])
def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch, root_exists):
    root = tmp_path / "deep" / "runs"
    if root_exists:
        root.mkdir(parents=True)
        (root / "other").mkdir()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_folder, "write_atomically", fail)
    with pytest.raises(InputError, match="No space left"):
        RunFolder.create(root, "dagger", "")
    assert [p.name for p in tmp_path.rglob("*")] == (["deep", "runs", "other"] if root_exists else [])


@pytest.mark.parametrize("exists", [True, False])
def test_a_folder_that_is_no_run_is_refused(tmp_path, exists):
    with pytest.raises(InputError, match=r"not a run folder \(config\.yaml is missing\)"):
        RunFolder.open(tmp_path if exists else tmp_path / "none")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: 0\n", "schema_version None"),
        ("schema_version: 1\n", "schema_version 1"),
        ("", "schema_version None"),
        ("- 1\n", "schema_version None"),
        ("a: [1\n", "cannot be read as YAML"),
        ("a: ${b}${\n", "cannot be read as YAML"),
        ("!!python/object/apply:os.mkdir [executed]\n", "cannot be read as YAML"),
        (b"\xff\xfe\x00", "cannot be read as YAML"),
    ],
)
def test_a_configuration_of_another_kind_is_refused_and_not_run(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message):
        RunFolder.open(tmp_path)
    assert not (tmp_path / "executed").exists()


def test_every_line_is_in_the_file_at_once(tmp_path):
    run = RunFolder.create(tmp_path, "dagger", "")
    assert run.read_metrics() == []
    for step in range(5):
        run.log(step, {"error": step / 2})
        lines = run.metrics_file.read_bytes().split(b"\n")
        assert lines.pop() == b""
        assert [json.loads(line) for line in lines] == [{"step": s, "error": s / 2} for s in range(step + 1)]


@given(values=st.dictionaries(st.text().filter(lambda key: key != "step"), st.floats(), max_size=5))
def test_metrics_come_back_and_are_strict_json(tmp_path_factory, values):
    run = RunFolder.create(tmp_path_factory.mktemp("runs"), "dagger", "")
    run.log(3, values)

    def refuse(constant):
        raise AssertionError(constant)

    json.loads(run.metrics_file.read_text(), parse_constant=refuse)
    (record,) = run.read_metrics()
    assert record.pop("step") == 3
    assert record.keys() == values.keys()
    for key, value in values.items():
        assert record[key] == value if math.isfinite(value) else math.isnan(record[key])


def test_tensors_and_numpy_numbers_are_metrics(tmp_path):
    run = RunFolder.create(tmp_path, "dagger", "")
    run.log(1, {"tensor": torch.tensor([0.5]), "numpy": np.float32(0.25), "count": 3})
    assert run.read_metrics() == [{"step": 1, "tensor": 0.5, "numpy": 0.25, "count": 3}]


def test_a_line_cut_by_a_crash_costs_only_itself(tmp_path):
    run = RunFolder.create(tmp_path, "dagger", "")
    run.log(1, {"error": 1.0})
    run.log(2, {"error": 2.0})
    run.metrics_file.write_bytes(run.metrics_file.read_bytes()[:-5])
    run.log(3, {"error": 3.0})
    with pytest.warns(UserWarning, match="line 2 of .* incomplete"):
        assert [record["step"] for record in run.read_metrics()] == [1, 3]


def test_write_returns_where_it_wrote(tmp_path):
    run = RunFolder.create(tmp_path, "dagger", "")
    path = run.write("table.md", "| a |")
    assert path == run.path / "table.md"
    assert path.read_text() == "| a |"


def test_half_written_files_of_a_killed_process_go_when_the_next_one_begins(tmp_path):
    run = RunFolder.create(tmp_path, "run", "seed: 0\n")
    (run.path / "videos").mkdir()
    left = [run.path / ".status.json.123.tmp", run.path / "videos" / ".round_00040.123.tmp.mp4"]
    theirs = run.path / ".evaluation.json.124.tmp"  # an evaluation may be at work meanwhile
    for file in (*left, theirs):
        file.touch()
    with run.lock():
        assert not any(file.exists() for file in left)
        assert theirs.exists()
    assert (run.path / "config.yaml").exists()
