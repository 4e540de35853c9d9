"""The worked examples of CONTRIBUTING.md work: what stands there is done in a copy of the repository."""

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

# Half-written files of other processes go away. Kept machine code comes with the copy, whose times are those of the
# sources: compiling anew took half a minute an example.
IGNORED = ("*.pyc.*", "*.tmp.*")


@dataclass(frozen=True)
class Example:
    """One worked example: new files, changed files, and the command that tries it."""

    title: str
    text: str

    def files(self) -> dict[str, str]:
        """Return the new files by path."""
        return dict(re.findall(r"^```(?:python|toml) (\S+)\n(.*?)^```$", self.text, re.MULTILINE | re.DOTALL))

    def changes(self) -> list[tuple[str, str, str]]:
        """Return path, what stands there and what shall stand there, hunk by hunk."""
        found: list[tuple[str, str, str]] = []
        for block in re.findall(r"^```diff\n(.*?)^```$", self.text, re.MULTILINE | re.DOTALL):
            for part in re.split(r"^--- ", block, flags=re.MULTILINE)[1:]:
                path, _, hunks = part.partition("\n")
                for hunk in re.split(r"^@@\n", hunks, flags=re.MULTILINE):
                    lines = hunk.splitlines(keepends=True)
                    before = "".join(line[1:] for line in lines if line[0] in " -")
                    found.append((path, before, "".join(line[1:] for line in lines if line[0] in " +")))
        return found

    def tried(self) -> tuple[list[str], str]:
        """Return what the command that tries it names: files or folders of tests, and which of their tests."""
        (command,) = re.findall(r"^    python -m pytest (.*)$", self.text, re.MULTILINE)
        places, *which = command.split(" -k ")
        return shlex.split(places), " ".join(shlex.split("".join(which))) or "test"


EXAMPLES = [Example(*part.split("\n", 1)) for part in PAGE.partition("## Worked examples\n")[2].split("\n### ")[1:]]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the repository in which all examples were followed, one after another."""
    folder = tmp_path_factory.mktemp("followed")
    for name in COPIED:
        # The data of tests are large, and linked to.
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
        for path, before, after in example.changes():
            text = (folder / path).read_text(encoding="utf-8")
            assert text.count(before) == 1, f"{path} has this {text.count(before)} times, 1 expected:\n{before}"
            (folder / path).write_text(text.replace(before, after), encoding="utf-8")
    return folder


def test_what_the_examples_write_is_as_the_checks_want_it(copy: Path) -> None:
    paths = {path for example in EXAMPLES for path in (*example.files(), *(path for path, _, _ in example.changes()))}
    changed = sorted(path for path in paths if path.endswith(".py"))
    # The order of imports is ruff's to mend.
    ruff = [sys.executable, "-m", "ruff", "check", "--no-cache"]
    run(copy, [*ruff, "--fix", "--select", "I", *changed])
    run(copy, [*ruff, *changed])
    run(copy, [sys.executable, "-m", "ruff", "format", "--no-cache", "--check", *changed])
    run(copy, [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"])


def test_the_worked_examples_work(copy: Path) -> None:
    """By one pytest for all, whose start takes longer than most of the tests."""
    tried = [example.tried() for example in EXAMPLES]
    which = " or ".join(f"(({' or '.join(Path(one).stem for one in places)}) and ({of}))" for places, of in tried)
    words = [sys.executable, "-m", "pytest", *(one for places, _ in tried for one in places), "-k", which]
    passed = re.findall(r"^PASSED (\S+?)::", run(copy, [*words, "-q", "-rA", "-p", "no:cacheprovider"]), re.MULTILINE)
    for places, _ in tried:
        for place in places:
            assert any(Path(one).is_relative_to(place) for one in passed), place


def run(folder: Path, words: list[str]) -> str:
    """Run a command in a folder, whose modules it finds first, and return what it prints."""
    settings = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(words, cwd=folder, env=settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(words)}:\n{done.stdout[-4000:]}{done.stderr[-2000:]}"
    return done.stdout
