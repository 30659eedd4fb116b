"""Settings, and the error messages for bad ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import pytest

from modgnn_rl.configs import schema
from modgnn_rl.configs.settings import check, setting
from modgnn_rl.errors import InputError, suggestion


@dataclass
class Inner:
    """Nested settings."""

    speed: float = setting(1.0, "speed, m/s", gt=0)


@dataclass
class Outer:
    """One setting of each kind."""

    inner: Inner = field(default_factory=Inner)
    count: Any = setting(3, "how many", ge=1, le=9, whole=True)
    kind: str = setting("a", "which", choices=("alpha", "a"))
    rates: list[float] = setting([1.0, 2.0], "rates", ge=0, length=2)
    name: str | None = setting(None, "name")
    limit: float | None = setting(None, "limit", gt=0)


def test_the_defaults_pass():
    check(Outer())


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"inner": Inner(0.0)}, r"run.inner.speed=0.0 is out of range: it must be greater than 0 \(speed, m/s\)"),
        ({"inner": Inner(float("nan"))}, "run.inner.speed is not a number"),
        ({"inner": Inner("fast")}, "run.inner.speed=fast is not a number"),  # type: ignore[arg-type]
        ({"count": 0}, "must be at least 1"),
        ({"count": [3, 10]}, "run.count=10 is out of range: it must be at most 9"),
        ({"count": 2.5}, "is not a whole number or a list of them"),
        ({"count": True}, "is not a whole number"),
        ({"count": None}, "is not a whole number"),
        ({"count": []}, r"run.count=\[\] has 0 values; it needs 1"),
        ({"kind": "alpa"}, "is not one of alpha, a; did you mean 'alpha'"),
        ({"rates": [1.0]}, "has 1 values; it needs 2"),
        ({"rates": [1.0, -1.0]}, "run.rates=-1.0 is out of range"),
        ({"limit": 0}, "run.limit=0 is out of range"),
    ],
)
def test_a_bad_value_is_named_with_what_was_expected(changes, sentence):
    with pytest.raises(InputError, match=sentence):
        check(dataclasses.replace(Outer(), **changes), "run")


def test_a_list_default_is_not_shared():
    first, second = Outer(), Outer()
    first.rates.append(3.0)
    assert second.rates == [1.0, 2.0]


def test_only_a_similar_word_is_suggested():
    assert suggestion("comm_rnge", ["comm_range", "seed"]) == "; did you mean 'comm_range'?"
    assert suggestion("xyz", ["comm_range", "seed"]) == ""


@pytest.mark.parametrize("name", [name for name in schema.__all__ if name.endswith("Config")])
def test_every_setting_is_documented(name):
    for item in dataclasses.fields(getattr(schema, name)):
        nested = dataclasses.is_dataclass(item.default_factory) or item.name == "trainer"
        assert nested or item.metadata["help"], f"{name}.{item.name}"
