"""Where a result comes from: commands, versions, hardware, times, commit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

__all__ = ["Provenance", "gather_provenance"]


@dataclass(frozen=True)
class Provenance:
    """What somebody needs to make the same result again.

    Attributes:
        commands: the exact commands, ready to paste.
        versions: version of each package, Python's first.
        hardware: processor, cores, memory, accelerator, system.
        times: how long each part took, in words, or when it began and ended.
        commit: of the repository, with "modified" where files differ from it; empty outside of a repository.
    """

    commands: Sequence[str]
    versions: Mapping[str, str]
    hardware: Mapping[str, str]
    times: Mapping[str, str]
    commit: str = ""


def gather_provenance(
    commands: Sequence[str] = (), *, started: datetime | None = None, times: Mapping[str, str] | None = None
) -> Provenance:
    """Describe this process and this machine.

    Args:
        commands: the exact commands; without any, the command that started this process.
        started: when the work began, with a time zone; the report then says when, and how long it took.
        times: further times to show, in words, such as ``{"training": "1 h 12 min on two cores"}``.
    """
    raise NotImplementedError
