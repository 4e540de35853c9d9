"""The page of causes is the table's."""

from __future__ import annotations

from pathlib import Path

from calibration.causes.reference import causes_page
from calibration.causes.rules import evidence_names

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "causes.md"


def test_the_page_is_written_from_the_table() -> None:
    assert PAGE.read_text() == causes_page(), f"write it anew: python -m calibration.causes.reference > {PAGE}"


def test_it_explains_all_evidence() -> None:
    page = causes_page()
    for name in evidence_names():
        assert f"| `{name}` | " in page
