"""Folders that are written whole or not at all, and whose files are verified by size and SHA-256."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from modgnn_rl.utils.files import fsync_file, fsync_folder, sha256

__all__ = ["describe_files", "verify_files", "write_folder"]


@contextlib.contextmanager
def write_folder(path: Path, *, hidden: bool = False) -> Iterator[Path]:
    """Create or replace a folder atomically.

    A crash leaves the old folder, the new one, or the old one as ``<path>.old``.

    Args:
        path: the folder; its parent must exist.
        hidden: use names that belong to this process, ``.<name>.<pid>.tmp`` and ``.<name>.<pid>.old``, where the parent
            is the user's own and may hold a ``<path>.old`` or ``<path>.tmp``, which would be removed.

    Yields:
        an empty folder ``<path>.tmp`` to write the files into. When the block ends without an exception, its files are
        synchronised to disk and it is renamed to ``path``; otherwise it is removed and an older folder stays as it was.

    Raises:
        OSError: the folder cannot be written.
    """
    name = f".{path.name}.{os.getpid()}" if hidden else path.name
    temporary, older = path.with_name(f"{name}.tmp"), path.with_name(f"{name}.old")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir()
        yield temporary
        for file in temporary.iterdir():
            fsync_file(file)
        fsync_folder(temporary)
        _replace(temporary, path, older)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    fsync_folder(path.parent)
    if older.exists():
        shutil.rmtree(older, ignore_errors=True)


def _replace(temporary: Path, path: Path, older: Path) -> None:
    """Rename a new folder to its final name; if that fails, the folder that it should replace is put back."""
    if not path.exists():
        os.replace(temporary, path)
        return
    shutil.rmtree(older, ignore_errors=True)
    os.replace(path, older)
    try:
        os.replace(temporary, path)
    except BaseException:  # Ctrl-C, too
        os.replace(older, path)
        raise


def describe_files(folder: Path) -> dict[str, dict[str, Any]]:
    """Size (``bytes``) and SHA-256 (``sha256``) of each file in a folder, by name."""
    return {
        file.name: {"sha256": sha256(file), "bytes": file.stat().st_size}
        for file in sorted(folder.iterdir())
        if file.is_file()
    }


def verify_files(folder: Path, files: Mapping[str, Mapping[str, Any]], *, hashes: bool = True) -> None:
    """Compare files with their description.

    Args:
        folder: the folder.
        files: what `describe_files` returned for them.
        hashes: read the files and compare their SHA-256; otherwise only sizes are compared.

    Raises:
        ValueError: which file is missing, or differs in what.
        OSError: a file cannot be read.
    """
    for name, expected in files.items():
        file = folder / name
        if file.parent != folder:
            raise ValueError(f"{name!r} is outside the folder")
        if not file.is_file():
            raise ValueError(f"{name} is missing")
        if (size := file.stat().st_size) != expected["bytes"]:
            raise ValueError(f"{name} has {size} bytes instead of {expected['bytes']}")
        if hashes and sha256(file) != expected["sha256"]:
            raise ValueError(f"the content of {name} has changed since it was written (SHA-256)")
