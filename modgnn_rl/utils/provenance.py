"""Provenance of a result: commands, versions, hardware, times, commit."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from modgnn_rl.utils.text import format_duration

__all__ = ["Provenance", "gather_provenance", "made_with"]

_PACKAGES = ("numpy", "hydra-core", "pybullet", "matplotlib")  # besides those of `made_with`


@dataclass(frozen=True)
class Provenance:
    """What is needed to reproduce a result.

    Attributes:
        commands: the exact commands, ready to paste.
        versions: version of each package, Python's first.
        hardware: processor, cores, memory, accelerator, system.
        times: when the work started and finished, and how long its parts took, in words.
        commit: git commit of the code, with ``-dirty`` if files differ from it; empty outside a repository.
    """

    commands: Sequence[str]
    versions: Mapping[str, str]
    hardware: Mapping[str, str]
    times: Mapping[str, str]
    commit: str = ""


def gather_provenance(
    commands: Sequence[str] = (), *, started: datetime | None = None, times: Mapping[str, str] | None = None
) -> Provenance:
    """Describe this process and this machine; nothing in it names the user or the host.

    Args:
        commands: the exact commands; default: the command that started this process.
        started: start of the work, with a time zone; start and duration are then part of the result.
        times: further times to show, in words, such as ``{"training": "1 h 12 min on two cores"}``.
    """
    now = datetime.now().astimezone()
    about = made_with()
    spans = {"finished": f"{now:%Y-%m-%d %H:%M %Z}"}
    if started is not None:
        taken = format_duration((now - started).total_seconds())
        spans = {"started": f"{started:%Y-%m-%d %H:%M %Z}", **spans, "total": taken}
    return Provenance(
        commands=list(commands) or [_this_command()],
        commit=about.pop("commit", ""),
        versions={"Python": platform.python_version(), **about, **_versions(_PACKAGES)},
        hardware=_hardware(),
        times={**spans, **(times or {})},
    )


def made_with() -> dict[str, str]:
    """Versions of this library and of its main dependencies, and the git commit of its code, if there is one."""
    about = _versions(("modgnn-rl", "torch", "torchrl", "tensordict"))
    folder = Path(__file__).parent
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        for command in ("ls-files --error-unmatch __init__.py", "describe --always --dirty --abbrev=40 --exclude=*"):
            answer = subprocess.run(
                ["git", "-C", str(folder), *command.split()], capture_output=True, text=True, check=True, timeout=5
            )
        about["commit"] = answer.stdout.strip()
    return about


def _versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of the packages that are installed."""
    found = {}
    for name in packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def _this_command() -> str:
    """The command line of this process, however Python was called."""
    return shlex.join(["python", *sys.orig_argv[1:]])


def _hardware() -> dict[str, str]:
    import torch

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = {"processor": _processor(), "cores": f"{usable}, of which torch uses {torch.get_num_threads()}"}
    with contextlib.suppress(ValueError, OSError, AttributeError):  # not available on this system
        found["memory"] = f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    devices = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    found["accelerator"] = ", ".join(devices) or "none"
    found["system"] = f"{platform.system()} {platform.machine()}"
    return found


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
