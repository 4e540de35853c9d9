"""The API reference is complete: it documents every public name of `croplab`."""

from __future__ import annotations

import re
from pathlib import Path

from evaluation import metrics
from generator import __all__ as rendering_names
from generator import training

PAGES = Path(__file__).parents[2] / "docs" / "reference" / "api"
DIRECTIVE = re.compile(r"^\.\. auto(?:function|class|data):: (\S+)$", re.MULTILINE)


def test_documents_every_public_name() -> None:
    documented = {name for page in PAGES.glob("*.rst") for name in DIRECTIVE.findall(page.read_text(encoding="utf-8"))}
    names = {name.rpartition(".")[2] for name in documented}
    assert {*rendering_names, *training.__all__, *metrics.__all__} - names == set()
