"""Registries: entries read from files, registered at run time, and brought by installed packages."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from modgnn_rl import registry
from modgnn_rl.errors import InputError
from modgnn_rl.registry import Reference, Registry

FILES = {
    "__init__.py": "",
    "schema.py": "class FastConfig:\n    pass\n",
    "deep/__init__.py": "",
    "deep/fast.py": '''
        raise RuntimeError("imported")
        from toybox.schema import FastConfig
        from modgnn_rl.registry import TOYS

        @TOYS.register("fast", settings=FastConfig, wheels=4)
        def fast():
            """A fast toy.

            A second paragraph.
            """

        class SlowConfig: ...

        @TOYS.register("slow", settings=SlowConfig)
        class Slow: ...
    ''',
}


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    """A registry that reads a package of two toys, which cannot be imported."""
    for name, text in FILES.items():
        path = tmp_path / "elsewhere" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    (tmp_path / "toybox").symlink_to(tmp_path / "elsewhere")  # as modgnn_rl/trainers is
    monkeypatch.syspath_prepend(tmp_path)
    yield Registry("toy", "TOYS", "toybox", plugins="toybox.toys")
    for name in [name for name in sys.modules if name.partition(".")[0] == "toybox"]:
        del sys.modules[name]


def test_entries_are_read_without_importing_the_files(toys: Registry) -> None:
    assert toys.names() == ["fast", "slow"]
    assert (toys["fast"].doc, toys["slow"].doc) == ("A fast toy.", "")
    assert toys["fast"].option("wheels") == 4
    assert toys["fast"].option("colour", "red") == "red"
    assert toys["fast"].option("settings").__name__ == "FastConfig"
    assert toys["slow"].options["settings"] == Reference("toybox.deep.fast", "SlowConfig")
    with pytest.raises(RuntimeError, match="imported"):
        toys["fast"].load()


def test_an_entry_of_a_script_can_be_replaced_and_a_built_in_one_cannot(toys: Registry) -> None:
    toys.register("mine", wheels=1)(len)
    assert toys.names() == ["fast", "slow", "mine"]
    assert (toys["mine"].load(), toys["mine"].option("wheels")) == (len, 1)
    toys.register("mine")(max)
    assert toys["mine"].load() is max
    with pytest.raises(InputError, match="toy 'fast' is built in; choose another name"):
        toys.register("fast")(max)


def test_an_installed_package_is_imported_when_its_entry_is_used(
    toys: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = []

    class Plugin(EntryPoint):
        def load(self) -> object:
            loaded.append(self.name)
            if self.name == "decorated":
                toys.register("decorated", wheels=3)(min)
            return min

    class Found(list[Plugin]):
        names = frozenset({"plain", "decorated"})

    def entry_points(*, group: str, name: str | None = None) -> Found:
        assert group == "toybox.toys"
        return Found(Plugin(found, "a:b", group) for found in sorted(Found.names) if name in (None, found))

    monkeypatch.setattr(registry, "entry_points", entry_points)
    assert toys.names() == ["fast", "slow", "decorated", "plain"]
    assert "plain" in toys
    assert toys.peek("plain") is None
    assert not loaded
    assert toys["plain"].load() is min
    assert toys["decorated"].option("wheels") == 3
    assert loaded == ["plain", "decorated"]
    assert toys["plain"] is toys["plain"]


def test_an_unknown_name_is_refused_with_a_suggestion(toys: Registry) -> None:
    with pytest.raises(InputError, match="toy 'fats' is not one of fast, slow; did you mean 'fast'"):
        toys["fats"]


def test_the_names_of_the_library_are_known_without_torch() -> None:
    code = "import sys; from modgnn_rl.registry import *; list(MODELS), list(TRAINERS); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("False\n", "")
