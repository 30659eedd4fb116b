"""Folders written as a whole, and their verification."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from modgnn_rl.utils.folders import describe_files, verify_files, write_folder


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def write(path: Path, content: bytes) -> None:
    with write_folder(path) as temporary:
        (temporary / "a").write_bytes(content)


def test_a_folder_is_created_and_replaced(tmp_path: Path) -> None:
    for content in (b"first", b"second"):
        write(tmp_path / "set", content)
        assert contents(tmp_path / "set") == {"a": content}
        assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize(
    "error", [OSError(5, "Input/output error"), KeyboardInterrupt("Ctrl-C")], ids=["disk", "ctrl-c"]
)
@pytest.mark.parametrize("failing", [1, 2])
def test_a_failed_rename_leaves_the_older_folder(
    failing: int, error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "set", b"old")
    replace, calls = os.replace, []

    def fail(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == failing:
            raise error
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(type(error)):
            write(tmp_path / "set", b"new")
    assert contents(tmp_path / "set") == {"a": b"old"}
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_an_exception_while_writing_leaves_the_older_folder(tmp_path: Path) -> None:
    def interrupted() -> None:
        with write_folder(tmp_path / "set") as temporary:
            (temporary / "a").write_bytes(b"half")
            raise KeyboardInterrupt

    write(tmp_path / "set", b"old")
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert contents(tmp_path / "set") == {"a": b"old"}
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda file: file.unlink(), "a is missing"),
        (lambda file: file.write_bytes(b"1234"), "a has 4 bytes instead of 5"),
        (lambda file: file.write_bytes(b"12346"), r"the content of a has changed .*SHA-256"),
    ],
)
def test_damage_is_named(damage, reason: str, tmp_path: Path) -> None:
    write(tmp_path / "set", b"12345")
    described = describe_files(tmp_path / "set")
    verify_files(tmp_path / "set", described)
    damage(tmp_path / "set" / "a")
    with pytest.raises(ValueError, match=reason):
        verify_files(tmp_path / "set", described)


def test_hashes_need_not_be_read(tmp_path: Path) -> None:
    write(tmp_path / "set", b"12345")
    described = describe_files(tmp_path / "set")
    (tmp_path / "set" / "a").write_bytes(b"54321")
    verify_files(tmp_path / "set", described, hashes=False)


def test_a_file_outside_the_folder_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "set", b"12345")
    (tmp_path / "b").write_bytes(b"12345")
    described = {"../b": describe_files(tmp_path / "set")["a"]}
    with pytest.raises(ValueError, match="outside the folder"):
        verify_files(tmp_path / "set", described)
