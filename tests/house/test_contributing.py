"""The worked examples of CONTRIBUTING.md work; they are carried out in a copy of the repository."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
COPIED = (
    "foundation",
    "drivers",
    "sim",
    "experiment",
    "acquisition",
    "calibration",
    "synthesis",
    "generator",
    "evaluation",
    "tests",
    "benchmarks",
    "examples",
)

# Temporary files of other processes disappear. Machine code is copied with the times of the sources, because compiling
# it again took half a minute per example.
IGNORED = ("*.pyc.*", "*.tmp.*")


@dataclass(frozen=True)
class Example:
    """A worked example: new files, changed files, and the command that tests it."""

    title: str
    text: str

    def files(self) -> dict[str, str]:
        """Return the new files by path."""
        return dict(re.findall(r"^```(?:python|toml) (\S+)\n(.*?)^```$", self.text, re.MULTILINE | re.DOTALL))

    def changes(self) -> list[tuple[str, str, str]]:
        """Return path, old text and new text of each hunk."""
        hunk_texts: list[tuple[str, str, str]] = []
        for block in re.findall(r"^```diff\n(.*?)^```$", self.text, re.MULTILINE | re.DOTALL):
            for file_diff in re.split(r"^--- ", block, flags=re.MULTILINE)[1:]:
                path, _, hunks = file_diff.partition("\n")
                for hunk in re.split(r"^@@\n", hunks, flags=re.MULTILINE):
                    lines = hunk.splitlines(keepends=True)
                    old = "".join(line[1:] for line in lines if line[0] in " -")
                    hunk_texts.append((path, old, "".join(line[1:] for line in lines if line[0] in " +")))
        return hunk_texts

    def selection(self) -> tuple[list[str], str]:
        """Return the test files or folders of the test command, and its selection of tests."""
        (command,) = re.findall(r"^    python -m pytest (.*)$", self.text, re.MULTILINE)
        paths, *filters = command.split(" -k ")
        return shlex.split(paths), " ".join(shlex.split("".join(filters))) or "test"


EXAMPLES = [Example(*part.split("\n", 1)) for part in PAGE.partition("## Worked examples\n")[2].split("\n### ")[1:]]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the repository in which all examples were carried out, one after another."""
    folder = tmp_path_factory.mktemp("followed")
    for name in COPIED:
        # The data of tests are large, so they are linked.
        linked = ("data",) if name == "tests" else ()
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns(*IGNORED, *linked))
    for data in (ROOT / "tests").rglob("data"):
        (folder / data.relative_to(ROOT)).symlink_to(data)
    (folder / "docs").mkdir()
    for name in ("pyproject.toml", "docs/lab.md"):
        shutil.copy(ROOT / name, folder / name)
    for example in EXAMPLES:
        for path, text in example.files().items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")
        for path, old, new in example.changes():
            text = (folder / path).read_text(encoding="utf-8")
            assert text.count(old) == 1, f"{path} has this {text.count(old)} times, 1 expected:\n{old}"
            (folder / path).write_text(text.replace(old, new), encoding="utf-8")
    return folder


def test_code_of_examples_passes_checks(copy: Path) -> None:
    paths = {path for example in EXAMPLES for path in (*example.files(), *(path for path, _, _ in example.changes()))}
    changed = sorted(path for path in paths if path.endswith(".py"))
    # ruff corrects the order of imports.
    ruff = [sys.executable, "-m", "ruff", "check", "--no-cache"]
    run(copy, [*ruff, "--fix", "--select", "I", *changed])
    run(copy, [*ruff, *changed])
    run(copy, [sys.executable, "-m", "ruff", "format", "--no-cache", "--check", *changed])
    run(copy, [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"])


def test_worked_examples_pass(copy: Path) -> None:
    """A single pytest runs all, because its start takes longer than most of the tests."""
    selection = [example.selection() for example in EXAMPLES]
    expression = " or ".join(
        f"(({' or '.join(Path(one).stem for one in paths)}) and ({of}))" for paths, of in selection
    )
    words = [sys.executable, "-m", "pytest", *(one for paths, _ in selection for one in paths), "-k", expression]
    passed = re.findall(r"^PASSED (\S+?)::", run(copy, [*words, "-q", "-rA", "-p", "no:cacheprovider"]), re.MULTILINE)
    for paths, _ in selection:
        for path in paths:
            assert any(Path(one).is_relative_to(path) for one in passed), path


def run(folder: Path, words: list[str]) -> str:
    """Run a command in a folder with its modules first on the path, and return the output."""
    settings = os.environ | {"PYTHONPATH": str(folder)}
    process = subprocess.run(words, cwd=folder, env=settings, capture_output=True, text=True, check=False)
    assert process.returncode == 0, f"{' '.join(words)}:\n{process.stdout[-4000:]}{process.stderr[-2000:]}"
    return process.stdout
