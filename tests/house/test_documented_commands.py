"""Every command that the documentation shows is one that the software takes: its options are there and fit each other.

The commands of the tutorial are run by `make demo`, those of the how-to pages by
`tests/end_to_end/test_how_to_commands.py` and rehearsal.md's by their own test. Here all are parsed, by the parsers
that the commands themselves use.
"""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from acquisition.run.plan import planned_steps
from croplab import COMMANDS
from experiment.config import load_lab
from experiment.lights import plan_illuminants

ROOT = Path(__file__).parents[2]
MADE = ("docs/reference/commands/",)
"""What a build of the site leaves there: help texts, not written by anybody."""

PAGES = sorted(
    page
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))
    if not page.relative_to(ROOT).as_posix().startswith(MADE)
)
TUTORIAL = ROOT / "docs" / "tutorials" / "first-dataset.md"


def commands_in(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of ours in the code blocks of a page, placeholders as they stand."""
    fenced = re.findall(r"^```(?:console|sh|bash|text)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    plain = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    indented = re.findall(r"(?:^    .*\n)+", plain + "\n", re.MULTILINE)
    for block in (*fenced, *indented):
        joined = re.sub(r"\\\n\s*", " ", block)
        for line in joined.splitlines():
            yield from _of_line(line.strip().removeprefix("$ "))


def _of_line(line: str) -> Iterator[list[str]]:
    if not re.match(rf"(?:[A-Z_]+=\S+ )*(?:{'|'.join(COMMANDS)}) ", line):
        return
    try:
        words = shlex.split(re.sub(r"\s#\s.*$", "", line))
    except ValueError:
        return
    words = words[next(k for k, word in enumerate(words) if word in COMMANDS) :]
    ends = [k for k, word in enumerate(words) if word in ("|", "&&", "||", ">", "2>", "&", ";") or "…" in word]
    yield words[: min(ends, default=len(words))]


def parse(words: list[str]) -> None:
    """Parse a command as it does itself, without running it."""
    command: Any = get_command(import_module(COMMANDS[words[0]]).app)
    rest = words[1:]
    if words[0] == "evaluate" and rest and not rest[0].startswith("-") and rest[0] not in command.commands:
        # Data alone are run with the usual methods (evaluation.cli).
        rest = ["run", *rest]
    while hasattr(command, "commands"):
        if (
            rest
            and rest[0] not in command.commands
            and any(one.param_type_name == "argument" for one in command.params)
        ):
            break
        assert rest, f"{words} names no command"
        assert rest[0] in command.commands, f"{rest[0]} is no command below {words[0]}"
        command, rest = command.commands[rest[0]], rest[1:]
    if any(word in ("--help", "-h", "--version") for word in rest):
        return
    context = command.make_context(words[0], rest)
    assert context is not None


FOUND = [(page.relative_to(ROOT).as_posix(), words) for page in PAGES for words in commands_in(page.read_text("utf-8"))]


def test_commands_are_found() -> None:
    pages = Counter(page for page, _ in FOUND)
    assert pages["docs/tutorials/first-dataset.md"] >= 8
    assert len(pages) >= 15
    assert len(FOUND) >= 60


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), FOUND, ids=[f"{page}: {' '.join(words)[:80]}" for page, words in FOUND])
def test_a_documented_command_is_taken(page: str, words: list[str]) -> None:
    try:
        parse(words)
    except Exception as error:
        # Click's errors and ours, whatever they are: the reader would see them.
        said = getattr(error, "message", None) or str(error)
        raise AssertionError(f"{page}: {' '.join(words)}: {type(error).__name__}: {said}") from error


def test_the_check_sees_what_is_wrong() -> None:
    for line in ("acquire chart out --no-such-option", "acquire sart out", "build-lut --window five s l"):
        with pytest.raises(BaseException, match=r"."):
            parse(shlex.split(line))


def test_the_tutorial_counts_the_frames_that_are_taken(tmp_path: Path) -> None:
    text = TUTORIAL.read_text("utf-8")
    settings = (ROOT / "acquisition" / "data" / "simulated.toml").read_text("utf-8")
    (tmp_path / "LAB.toml").write_text(settings)
    asked = re.search(r"--grid (\d+) --blackbodies (\d+):(\d+):(\d+)", text)
    assert asked is not None
    grid, first, last, step = map(int, asked.groups())
    lights = plan_illuminants(grid, tuple(range(first, last + 1, step)))
    steps = planned_steps(load_lab(tmp_path / "LAB.toml"), lights)
    kinds = Counter(step.kind for step in steps)
    assert f"these are {len(lights)}." in text
    counts = re.search(
        r"There are (\d+) frames: a white and a dark frame, (\d+) response frames", " ".join(text.split())
    )
    assert counts is not None
    assert (int(counts[1]), int(counts[2])) == (len(steps), kinds["response"])
    assert (kinds["white"], kinds["dark"]) == (2, 2)
    assert f"complete, {len(steps)} frames;" in text
    assert f"frames  {len(steps)} of {len(steps)}" in text
    assert f"lights  {len(lights)} of {len(lights)}" in text
    photographs = 4
    assert f"has {photographs * len(lights)} PNG files" in text
