"""Records are restored from JSON, and errors name the damaged key."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.errors import FormatError
from foundation.records import FloatArray, Record, from_json, from_plain, to_plain


@dataclass(frozen=True, eq=False)
class Measured:
    counts: FloatArray
    name: str = ""


class Written(Record):
    light: int
    seen: tuple[str, ...] = ()


@given(st.lists(st.lists(st.floats(allow_infinity=False), min_size=3, max_size=3), max_size=4), st.text())
def test_restores_arrays_exactly(rows: list[list[float]], name: str) -> None:
    counts = np.array(rows, dtype=np.float64)
    read = from_json(Measured, json.dumps(to_plain(Measured(counts, name))), "a.json", "make it again")
    np.testing.assert_array_equal(read.counts, counts)
    assert read.name == name


def test_ignores_keys_of_later_versions() -> None:
    assert from_plain(Written, {"light": 3, "newer": 1}, "a.json", "") == Written(light=3)


def test_writes_nan_and_infinity_as_null() -> None:
    assert to_plain(Measured(np.array([1.0, np.nan, np.inf])))["counts"] == [1.0, None, None]


@pytest.mark.parametrize(
    ("text", "key"), [('{"light": "x"}', "light"), ("{}", "light"), ('{"light": 1, "seen": 2}', "seen")]
)
def test_error_names_the_damaged_key(text: str, key: str) -> None:
    with pytest.raises(FormatError, match=f"^a.json: .*{key}") as caught:
        from_json(Written, text, "a.json", "restore it from a copy")
    assert (caught.value.about, caught.value.remedy) == ("a.json", "restore it from a copy")
