"""Atomic writing: the old content or the new, whatever fails in between."""

from __future__ import annotations

import hashlib
import os

import pytest

from modgnn_rl.utils import files


@pytest.mark.parametrize(("data", "expected"), [("é\n", "é\n".encode()), (b"\x00\xff", b"\x00\xff"), ("", b"")])
def test_writes_text_and_bytes(tmp_path, data, expected):
    path = tmp_path / "table.md"
    files.write_atomically(path, data)
    assert path.read_bytes() == expected
    assert list(tmp_path.iterdir()) == [path]
    assert files.sha256(path) == hashlib.sha256(expected).hexdigest()


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_failure_keeps_the_old_content_and_leaves_nothing_behind(tmp_path, monkeypatch, broken):
    path = tmp_path / "table.md"
    files.write_atomically(path, "old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, broken, fail)
    with pytest.raises(OSError, match="No space left"):
        files.write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_content_reaches_the_disk_before_the_name_and_the_name_before_return(tmp_path, monkeypatch):
    calls = []
    fsync, replace = os.fsync, os.replace

    def traced_fsync(descriptor):
        calls.append("fsync " + os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    def traced_replace(source, target):
        calls.append(f"replace {target}")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", traced_fsync)
    monkeypatch.setattr(os, "replace", traced_replace)
    files.write_atomically(tmp_path / "a", "x")
    first, second, third = calls
    assert first.startswith(f"fsync {tmp_path}/.a.")
    assert second == f"replace {tmp_path}/a"
    assert third == f"fsync {tmp_path}"
