"""The commands of the tutorial equal those of `make demo`, which runs them."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
COMMANDS = "acquire|build-lut|generate|evaluate|python"


def test_tutorial_has_commands_of_demo() -> None:
    tutorial = (ROOT / "docs" / "tutorials" / "first-dataset.md").read_text(encoding="utf-8")
    written = re.findall(rf"^    ((?:{COMMANDS}) .*)$", tutorial, re.MULTILINE)
    recipe = re.search(r"^demo:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert recipe is not None
    demo = re.findall(rf"^\t\$\(BIN\)/((?:{COMMANDS}) .*)$", recipe[1], re.MULTILINE)
    assert [line.replace("../../", "") for line in written] == [line.replace("$(DEMO)/", "") for line in demo]
