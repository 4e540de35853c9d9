"""The pages of figures and causes are the code's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from calibration.causes.rules import evidence_names
from calibration.figures.all_figures import FIGURES
from docs.reference_pages import causes_page, figures_page

PAGES = Path(__file__).parents[2] / "docs" / "reference"


@pytest.mark.parametrize(("name", "page"), [("figures", figures_page), ("causes", causes_page)])
def test_a_page_is_written_from_the_code(name: str, page: Callable[[], str]) -> None:
    assert (PAGES / f"{name}.md").read_text() == page(), "write it anew: python -m docs.reference_pages"


def test_they_explain_all_figures_and_all_evidence() -> None:
    page = figures_page()
    assert all(f"(`{figure.name}`" in page for figure in FIGURES)
    assert all(f"| `{name}` | " in causes_page() for name in evidence_names())
