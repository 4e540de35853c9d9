"""Make what docs/gallery.md shows: `python -m docs.gallery`, which the site's build calls.

The commands of the page run as they stand, one after another, in a folder that is removed. What the page names below
`gallery/` is copied to docs/gallery, which is in no repository.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path

from docs.recheck import ROOT, run_commands

PAGE = ROOT / "docs" / "gallery.md"


def make(page: Path = PAGE) -> list[Path]:
    """Run the commands of a page and return the files that it shows, beside it.

    Raises
    ------
    RuntimeError
        The commands ended with another code than 0, or left no such file.
    """
    text = page.read_text(encoding="utf-8")
    commands = "\n".join(re.findall(r"^    (.+)$", text, re.MULTILINE))
    named = sorted(set(re.findall(r"\bgallery/([\w./-]+)", text)))
    made: list[Path] = []
    with tempfile.TemporaryDirectory(prefix="crop-") as folder:
        Path(folder, "examples").symlink_to(ROOT / "examples")
        done = run_commands(commands, Path(folder))
        if done.returncode:
            raise RuntimeError(f"the commands of {page} ended with {done.returncode}: {done.stderr[-500:]}")
        for name in named:
            target = page.parent / "gallery" / name
            if not Path(folder, name).is_file():
                raise RuntimeError(f"{page} shows gallery/{name}, which its commands did not make")
            target.parent.mkdir(parents=True, exist_ok=True)
            made.append(shutil.copyfile(Path(folder, name), target))
    return made


if __name__ == "__main__":
    for place in make():
        print(place.relative_to(ROOT))
