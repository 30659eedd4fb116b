"""Checkpoints: exact, whole or absent, verified, unable to run code."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from modgnn_rl.errors import InputError
from modgnn_rl.tracking.checkpoint import load_checkpoint, save_checkpoint
from modgnn_rl.utils.files import sha256

FILES = ["manifest.json", "optimizer.safetensors", "policy.safetensors", "state.json"]


def save(folder, step, **options):
    """Save a checkpoint whose content tells its step."""
    tensors = {"policy": {"w": torch.full((2, 3), float(step))}, "optimizer": {"m": torch.arange(4) + step}}
    return save_checkpoint(folder, step, tensors, {"round": step, "lr": 0.1}, **options)


def loaded_step(folder):
    """Load the newest checkpoint, check that its parts belong together, and return its step."""
    found = load_checkpoint(folder)
    assert found.state == {"round": found.step, "lr": 0.1}
    assert torch.equal(found.tensors["policy"]["w"], torch.full((2, 3), float(found.step)))
    assert torch.equal(found.tensors["optimizer"]["m"], torch.arange(4) + found.step)
    return found.step


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool]
)
def test_round_trip_is_exact(tmp_path, dtype):
    bits = torch.randint(0, 256, (3, 8, 5), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    if dtype is torch.bool:
        value = bits > 128
    else:
        value = bits.view(dtype)[..., :1] if dtype.itemsize == 1 else bits.mT.contiguous().view(dtype)
    scalar, empty, turned = value.flatten()[0], value[:0], value.transpose(0, 1)
    saved = {"value": value, "scalar": scalar, "empty": empty, "turned": turned}
    save_checkpoint(tmp_path, 0, {"policy": saved, "nothing": {}}, {})
    found = load_checkpoint(tmp_path).tensors
    assert found["nothing"] == {}
    for key, expected in saved.items():
        got = found["policy"][key]
        assert (got.dtype, got.shape) == (expected.dtype, expected.shape)
        as_bytes = [t.contiguous().reshape(-1).view(torch.uint8).tolist() for t in (got, expected)]
        assert as_bytes[0] == as_bytes[1]


def test_tensors_that_share_memory(tmp_path):
    whole = torch.arange(12.0).reshape(3, 4)
    tied = torch.nn.Linear(4, 4)
    saved = {"whole": whole, "row": whole[1], "column": whole[:, 1], "again": whole, "wide": whole[:1].expand(5, 4)}
    saved |= {"weight": tied.weight, "same_weight": tied.weight}
    save_checkpoint(tmp_path, 3, {"policy": saved}, {})
    found = load_checkpoint(tmp_path).tensors["policy"]
    assert all(torch.equal(found[key], value) for key, value in saved.items())


@settings(max_examples=50)
@given(
    state=st.dictionaries(
        st.text(),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
            lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
            max_leaves=8,
        ),
        max_size=4,
    )
)
def test_state_comes_back_equal(tmp_path_factory, state):
    folder = tmp_path_factory.mktemp("checkpoints")
    save_checkpoint(folder, 0, {}, state)
    assert load_checkpoint(folder).state == state


def test_state_that_is_not_json_is_refused_and_nothing_is_left(tmp_path):
    save(tmp_path, 1)
    with pytest.raises(TypeError):
        save_checkpoint(tmp_path, 2, {}, {"w": torch.ones(2)})
    assert names(tmp_path) == ["step_000000001"]


def test_layout_is_as_documented(tmp_path):
    path = save(tmp_path / "run" / "checkpoints", 12)
    assert path == tmp_path / "run" / "checkpoints" / "step_000000012"
    assert names(path) == FILES
    manifest = json.loads((path / "manifest.json").read_text())
    assert (manifest["schema_version"], manifest["step"]) == (1, 12)
    assert sorted(manifest["files"]) == [name for name in FILES if name != "manifest.json"]


def test_keeps_the_newest_and_clears_leftovers(tmp_path):
    (tmp_path / "step_000000007.tmp").mkdir()
    (tmp_path / "step_notes").mkdir()
    for step in (8, 9, 10):
        save(tmp_path, step)
    assert names(tmp_path) == ["step_000000009", "step_000000010", "step_notes"]
    save(tmp_path, 1_000_000_000, keep=1)
    assert names(tmp_path) == ["step_1000000000", "step_notes"]
    assert loaded_step(tmp_path) == 1_000_000_000


def test_a_run_that_went_back_replaces_what_it_left(tmp_path):
    for step in (1, 2, 3):
        save(tmp_path, step, keep=3)
    save(tmp_path, 2, keep=3)
    assert names(tmp_path) == ["step_000000001", "step_000000002"]
    assert loaded_step(tmp_path) == 2


@pytest.mark.parametrize(("step", "keep"), [(-1, 2), (1, 0)])
def test_impossible_numbers_are_refused(tmp_path, step, keep):
    with pytest.raises(InputError):
        save(tmp_path / "new", step, keep=keep)
    assert not (tmp_path / "new").exists()


class _Crash(BaseException):
    """The process is gone."""


class _MortalDisk:
    """Lets some file-system calls through, then fails for good, as for a process that was killed."""

    def __init__(self, monkeypatch, alive_for):
        self.calls, self.alive_for = 0, alive_for
        for owner, name in [
            (os, "fsync"),
            (os, "replace"),
            (shutil, "rmtree"),
            (Path, "mkdir"),
            (Path, "write_text"),
            (Path, "write_bytes"),
        ]:
            monkeypatch.setattr(owner, name, self._mortal(getattr(owner, name)))

    def _mortal(self, function):
        def call(*args, **kwargs):
            if self.calls >= self.alive_for:
                raise _Crash
            self.calls += 1
            return function(*args, **kwargs)

        return call


@pytest.mark.parametrize("new_step", [2, 3], ids=["same step again", "next step"])
def test_a_crash_at_any_call_leaves_a_whole_checkpoint(tmp_path, new_step):
    finished = False
    for alive_for in range(100):
        folder = tmp_path / str(alive_for)
        save(folder, 1)
        save(folder, 2)
        with pytest.MonkeyPatch.context() as patch:
            _MortalDisk(patch, alive_for)
            try:
                save(folder, new_step)
                finished = True
            except _Crash:
                pass
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert loaded_step(folder) in (2, new_step)
        save(folder, 4)
        assert loaded_step(folder) == 4
        assert not [name for name in names(folder) if "." in name]
        if finished:
            break
    assert finished
    assert alive_for > 10


def test_a_full_disk_leaves_the_older_ones_and_no_litter(tmp_path, monkeypatch):
    save(tmp_path, 1)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space"):
        save(tmp_path, 2)
    assert names(tmp_path) == ["step_000000001"]
    assert loaded_step(tmp_path) == 1


def test_everything_is_on_the_disk_before_the_name_and_the_name_before_pruning(tmp_path, monkeypatch):
    save(tmp_path, 1)
    calls = []
    fsync, replace, rmtree = os.fsync, os.replace, shutil.rmtree

    def traced_fsync(descriptor):
        calls.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", traced_fsync)
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("rename"), replace(a, b)))
    monkeypatch.setattr(shutil, "rmtree", lambda p, **k: (calls.append(f"remove {p}"), rmtree(p, **k)))
    save(tmp_path, 2, keep=1)
    new = f"{tmp_path}/step_000000002.tmp"
    before = calls[: calls.index("rename")]
    assert {f"{new}/{name}" for name in FILES} <= set(before)
    assert before[-1] == new
    assert calls[calls.index("rename") + 1 :] == [str(tmp_path), f"remove {tmp_path}/step_000000001"]


def damaged_forms(data):
    """Yield a file's content cut at every length and with one bit flipped, at up to about 200 places each."""
    stride = max(1, len(data) // 200)
    for place in range(0, len(data), stride):
        yield data[:place]
        flipped = bytearray(data)
        flipped[place] ^= 1 << (place % 8)
        yield bytes(flipped)


@pytest.mark.filterwarnings("ignore:CHECKPOINT SKIPPED")
@pytest.mark.parametrize("name", FILES)
def test_every_cut_and_every_flipped_bit_is_noticed(tmp_path, name):
    save(tmp_path, 1)
    file = save(tmp_path, 2) / name
    whole = file.read_bytes()
    for damaged in damaged_forms(whole):
        file.write_bytes(damaged)
        assert loaded_step(tmp_path) == 1
    file.unlink()
    assert loaded_step(tmp_path) == 1
    file.write_bytes(whole)
    assert loaded_step(tmp_path) == 2


def test_falling_back_is_loud(tmp_path):
    save(tmp_path, 1)
    file = save(tmp_path, 2) / "policy.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.warns(RuntimeWarning, match=r"SKIPPED.*step_000000002 \(policy.safetensors has \d+ bytes") as caught:
        assert loaded_step(tmp_path) == 1
    assert len(caught) == 1


@pytest.mark.filterwarnings("ignore:CHECKPOINT SKIPPED")
def test_all_damaged_is_refused_with_each_reason(tmp_path):
    (save(tmp_path, 1) / "state.json").write_text("{}")
    (save(tmp_path, 2) / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"step_000000002: .*manifest.json.*step_000000001: state.json has 2 bytes"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("exists", [True, False])
def test_no_checkpoint_is_refused(tmp_path, exists):
    with pytest.raises(InputError, match=r"no checkpoint in .*expected"):
        load_checkpoint(tmp_path if exists else tmp_path / "none")


def rewrite_manifest(path, **changes):
    """Change a checkpoint's manifest as a forger would, hashes made right."""
    manifest = json.loads((path / "manifest.json").read_text())
    for name in manifest["files"]:
        manifest["files"][name] = {"sha256": sha256(path / name), "bytes": (path / name).stat().st_size}
    (path / "manifest.json").write_text(json.dumps(manifest | changes))


@pytest.mark.filterwarnings("ignore:CHECKPOINT SKIPPED")
@pytest.mark.parametrize("forged", [False, True], ids=["plain", "with its hash in the manifest"])
@pytest.mark.parametrize("form", ["pickle", "torch"])
@pytest.mark.parametrize("name", ["policy.safetensors", "state.json", "manifest.json"])
def test_a_pickle_is_refused_and_not_run(tmp_path, forged, form, name):
    mark = tmp_path / "executed"

    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(mark),)

    folder = tmp_path / "checkpoints"
    path = save(folder, 1)
    if form == "pickle":
        (path / name).write_bytes(pickle.dumps(Malicious()))
    else:
        torch.save(Malicious(), path / name)
    if forged and name != "manifest.json":
        rewrite_manifest(path)
    with pytest.raises(InputError, match="can be used"):
        load_checkpoint(folder)
    assert not mark.exists()


@pytest.mark.filterwarnings("ignore:CHECKPOINT SKIPPED")
@pytest.mark.parametrize(
    "changes",
    [
        {"schema_version": 2},
        {"step": 5},
        {"files": {}},
        {"files": []},
    ],
)
def test_a_manifest_of_another_kind_is_refused(tmp_path, changes):
    rewrite_manifest(save(tmp_path, 1), **changes)
    with pytest.raises(InputError, match="can be used"):
        load_checkpoint(tmp_path)


@pytest.mark.filterwarnings("ignore:CHECKPOINT SKIPPED")
def test_a_manifest_cannot_reach_outside_its_folder(tmp_path):
    path = save(tmp_path, 1)
    files = json.loads((path / "manifest.json").read_text())["files"]
    shutil.copy(path / "policy.safetensors", tmp_path / "secret.safetensors")
    rewrite_manifest(path, files=files | {"../secret.safetensors": files["policy.safetensors"]})
    with pytest.raises(InputError, match="outside the folder"):
        load_checkpoint(tmp_path)


def test_files_have_the_usual_rights(tmp_path):
    (tmp_path / "usual").touch()
    path = save(tmp_path / "checkpoints", 1)
    assert {file.stat().st_mode for file in path.iterdir()} == {(tmp_path / "usual").stat().st_mode}
