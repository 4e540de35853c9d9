"""Generated parts of the documentation agree with the code and with the recorded results."""

from __future__ import annotations

from calibration.causes.rules import evidence_names
from calibration.figures.all_figures import FIGURES
from docs.reference_pages import causes_page, figures_page, generated_pages


def test_pages_are_up_to_date() -> None:
    outdated = [path.name for path, text in generated_pages().items() if path.read_text(encoding="utf-8") != text]
    assert outdated == [], "run python -m docs.reference_pages"


def test_pages_name_every_figure_and_all_evidence() -> None:
    page = figures_page()
    assert all(f"(`{figure.name}`" in page for figure in FIGURES)
    assert all(f"| `{name}` | " in causes_page() for name in evidence_names())
