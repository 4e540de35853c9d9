"""Make the files of docs/gallery.md: `python -m docs.gallery`; the build of the site calls it.

The commands of the page run one after another in a temporary folder. Files that the page names below `gallery/` are
copied to docs/gallery, which git ignores.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path

from docs.recheck import ROOT, run_commands

PAGE = ROOT / "docs" / "gallery.md"


def make(page: Path = PAGE) -> list[Path]:
    """Run the commands of a page and copy the files that it shows next to it.

    Raises
    ------
    RuntimeError
        if the commands fail or do not make a file
    """
    text = page.read_text(encoding="utf-8")
    commands = "\n".join(re.findall(r"^    (.+)$", text, re.MULTILINE))
    file_names = sorted(set(re.findall(r"\bgallery/([\w./-]+)", text)))
    files: list[Path] = []
    with tempfile.TemporaryDirectory(prefix="crop-") as folder:
        Path(folder, "examples").symlink_to(ROOT / "examples")
        process = run_commands(commands, Path(folder))
        if process.returncode:
            raise RuntimeError(
                f"the commands of {page} ended with exit code {process.returncode}, 0 expected: {process.stderr[-500:]}"
            )
        for name in file_names:
            target = page.parent / "gallery" / name
            if not Path(folder, name).is_file():
                raise RuntimeError(f"{page} shows gallery/{name}, but its commands did not make it; correct the page")
            target.parent.mkdir(parents=True, exist_ok=True)
            files.append(shutil.copyfile(Path(folder, name), target))
    return files


if __name__ == "__main__":
    for file in make():
        print(file.relative_to(ROOT))
