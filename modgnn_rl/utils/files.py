"""Atomic file writes, and checksums."""

from __future__ import annotations

import contextlib
import hashlib
import os
from pathlib import Path

__all__ = ["fsync_file", "fsync_folder", "sha256", "write_atomically"]


def write_atomically(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write a file atomically: a crash leaves the old content or the new, never a part of it.

    Args:
        path: the file to write; its folder must exist.
        data: the new content; text is encoded as UTF-8.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)
        fsync_file(temporary)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    fsync_folder(path.parent)


def fsync_file(path: str | os.PathLike[str]) -> None:
    """Wait until the content of a file is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_folder(path: str | os.PathLike[str]) -> None:
    """Wait until the entries of a folder are on disk: POSIX requires it after a rename, Windows cannot do it."""
    if os.name == "posix":
        fsync_file(path)


def sha256(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of a file as 64 lower-case hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
