"""Links between the repository's pages lead to files; `make docs`, which takes minutes, asks for headings, too."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md"))
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)#\s]+)")
# What `make docs` itself writes is not there before it.
WRITTEN = ("docs/gallery", "docs/reference/api", "docs/reference/commands")


def test_links_lead_to_files() -> None:
    dead: list[tuple[str, str]] = []
    for page in PAGES:
        for target in LINK.findall(page.read_text(encoding="utf-8")):
            names = [str(path.relative_to(ROOT)) for path in (page, (page.parent / target).resolve())]
            if not any(name.startswith(WRITTEN) for name in names) and not (ROOT / names[1]).exists():
                dead.append((names[0], names[1]))
    assert dead == []
