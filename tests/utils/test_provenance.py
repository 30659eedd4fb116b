"""Where results come from."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
import sys
from datetime import datetime, timedelta
from pathlib import Path

from modgnn_rl.utils.provenance import gather_provenance, made_with


def test_what_a_run_was_made_with():
    about = made_with()
    assert about["torchrl"] == importlib.metadata.version("torchrl")
    root = Path(__file__).parents[2]
    git = subprocess.run(["git", "-C", root, "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    if git.returncode == 0:
        assert about["commit"].removesuffix("-dirty") == git.stdout.strip()
    else:
        assert "commit" not in about


def test_the_command_can_be_pasted_and_nothing_names_the_host(monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", ["/opt/venv/bin/python", "-m", "modgnn_rl.reproduce", "name=a b"])
    found = gather_provenance(started=datetime.now().astimezone() - timedelta(minutes=3), times={"training": "1 min"})
    assert found.commands == ["python -m modgnn_rl.reproduce 'name=a b'"]
    assert list(found.times) == ["started", "finished", "total", "training"]
    assert found.times["total"] == "3 min"
    assert next(iter(found.versions)) == "Python"
    assert found.versions["numpy"] == importlib.metadata.version("numpy")
    assert platform.node() not in str(found).split()
    assert gather_provenance(["one", "two"]).commands == ["one", "two"]
