"""Run the commands of the how-to pages, page by page, each in a folder with the files that it names.

A small simulated laboratory, a computed LUT of 64 colours and small generated data sets replace the real ones.
`Page.skipped` lists commands that cannot run here, with the reason. The commands of rehearsal.md have a separate test;
`make demo` runs those of the tutorial.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from croplab import COMMANDS
from tests.house.test_documented_commands import FOUND

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn", "unplotted")]

HOW_TO = "docs/how-to/"
# Pages with a separate test.
ELSEWHERE = {"rehearsal.md"}

LAB = 'rig = "simulated"\nchart = "chart/chart.json"\nilluminations = "illuminations.csv"\n[sequence]\nwarm_up_s = 0\n'
SIMULATED = '[simulated]\nbody = "Test"\nseed = 11\n'
_REAL = "needs the real data set of the page; tests/evaluation/commands uses an artificial one"
_SERVES = "runs until it is ended; tests/acquisition/monitor, tests/generator/explore"


@dataclass(frozen=True)
class Page:
    """Conditions for the commands of a page."""

    needs: Mapping[str, str] = field(default_factory=dict[str, str])  # names in the folder, and their sources
    written: Mapping[str, str] = field(default_factory=dict[str, str])  # words of the page, and their replacements
    added: Mapping[str, str] = field(default_factory=dict[str, str])  # beginnings of commands, and words added to them
    # beginnings of commands, and results to remove first
    fresh: Mapping[str, str] = field(default_factory=dict[str, str])
    # commands that fail here, and part of the message
    refused: Mapping[str, str] = field(default_factory=dict[str, str])
    # beginnings of commands that are not run, and the reason
    skipped: Mapping[str, str] = field(default_factory=dict[str, str])


_LAB = {name: name for name in ("LAB.toml", "chart", "illuminations.csv")}
_GENERATE = {"lut": "computed", "photographs": "pictures"}

PAGES = {
    "check.md": Page(_LAB),
    "citing.md": Page({"lut": "lut"}),
    "comparing.md": Page(
        {"runs/cube-plus": "results", "runs/before": "results", "runs/after": "results"}
        | {"runs/a": "results", "runs/b": "results"},
        written={"Gray-world=Mine": "Gray-world=White-Patch"},
    ),
    "evaluate.md": Page(
        {"DATA": "dataset", "brightest.py": "brightest.py", "c5.csv": "estimates.csv", "out/fc4.csv": "estimates.csv"},
        fresh={"evaluate": "RESULTS"},
    ),
    "explore.md": Page(
        _GENERATE, written={"photographs/coffee.png": "photographs/0.png"}, skipped={"generate explore": _SERVES}
    ),
    "import.md": Page(skipped={"": "tests/acquisition/run has the raw files of another program"}),
    "monitor.md": Page(skipped={"": _SERVES}),
    "night-run.md": Page(
        _LAB | {"session": "session"},
        refused={"acquire run LAB.toml session/ --retake bad": "has no frame to repeat"},
        skipped={"acquire monitor": _SERVES},
    ),
    "publishing.md": Page({"dataset": "dataset", "copy": "dataset", "lut": "lut"}),
    "rendering.md": Page(_GENERATE | {"lights.csv": "gt.txt"}, fresh={"generate": "out"}),
    "repeatability.md": Page(
        dict.fromkeys(("monday", "friday", "session"), "session")
        | {"monday.lut": "lut", "friday.lut": "lut", "chart": "chart"}
    ),
    "table-without-a-lab.md": Page(
        {"small.toml": "small.toml", "mine.json": "mine.json", "photographs": "pictures"},
        written={"cie,2000:10000:200K": "cie-d,2000:10000:2000K"},
        # 32 768 colours and 707 illuminants would take a minute.
        added={"sim table": "--settings small.toml", "sim table lut/ --camera Canon": "--lights 2000:10000:2000K"},
        fresh={"sim table": "lut"},
    ),
    "taking-a-session.md": Page(
        _LAB,
        written={"12,40-44": "1,2-3"},
        refused={"acquire run LAB.toml SESSION --retake bad": "has no report of build-lut on SESSION"},
    ),
    "train-and-cross-validate.md": Page(
        {"DATA": "dataset", "OTHER": "dataset"},
        skipped={
            "generate LUT": _REAL,
            "evaluate train regression-trees": _REAL,
            "evaluate run OTHER --method adapted.npz": _REAL,
        },
    ),
    "train-on-crops.md": Page(skipped={"": _REAL}),
    "training-set.md": Page(skipped={"": _REAL}),
    "transfer.md": Page(skipped={"": _REAL}),
    "tune.md": Page({"DATA": "dataset", "OTHER": "dataset"}),
    "variation.md": Page(
        _GENERATE | {"photographs": "large"},
        fresh={"generate": "out"},
    ),
}


def run(*words: object) -> int:
    """Run a command as the shell does and return its exit code."""
    name, *arguments = map(str, words)
    return int(import_module(COMMANDS[name]).main(arguments))


@pytest.fixture(scope="module")
def unplotted() -> Iterator[None]:
    """Skip drawing the plots of results, which other tests check."""

    def blank(draw: Callable[..., None], *arguments: object, inches: tuple[float, float]) -> bytes:
        return b"<svg></svg>"

    with pytest.MonkeyPatch.context() as patched:
        for page in ("reports.run_page", "experiments.comparing"):
            patched.setattr(f"evaluation.{page}.draw_svg", blank)
        yield


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with everything that a page may need."""
    folder = tmp_path_factory.mktemp("made")
    rng = np.random.default_rng(1)
    # Large pictures have four separate areas of 512 × 512.
    for kind, count, side in (("pictures", 4, 48), ("large", 2, 1040)):
        (folder / kind).mkdir()
        for number in range(count):
            blocks = rng.integers(0, 256, (side // 8, side // 8, 3), dtype=np.uint8)
            cv2.imwrite(str(folder / kind / f"{number}.png"), cv2.resize(blocks, (side, side), interpolation=0))
    (folder / "small.toml").write_text("[chart]\nbits = 2\n")
    sensitivities = next((Path(__file__).parents[2] / "sim" / "data").rglob("*EOS_600D*.json"))
    shutil.copy(sensitivities, folder / "mine.json")
    assert run("acquire", "chart", folder / "chart", "--bits", 2, "--no-tiff") == 0
    assert run("acquire", "illuminations", folder / "illuminations.csv", "--grid", 1, "--blackbodies", "3000,5000") == 0
    (folder / "LAB.toml").write_text(LAB + "[judge]\nresponse = false\n" + SIMULATED)
    assert run("acquire", "run", folder / "LAB.toml", folder / "session") == 0
    assert run("build-lut", folder / "session", folder / "lut") == 0
    parts = ("--split", "1,1")
    spectra = ("--lights", "2000:10000:2000K,D65")
    assert run("sim", "table", folder / "computed", "--settings", folder / "small.toml", *spectra) == 0
    assert run("generate", folder / "computed", folder / "dataset", "--sources", folder / "pictures", *parts) == 0
    shutil.copy(folder / "dataset" / "gt.txt", folder / "gt.txt")
    assert run("evaluate", "run", folder / "dataset", "--out", folder / "results") == 0
    rows = [line.split(",") for line in (folder / "dataset" / "ground_truth.csv").read_text().splitlines()[1:]]
    estimates = [",".join([row[0], *row[-3:]]) for row in rows]
    (folder / "estimates.csv").write_text("\n".join(["image,r,g,b", *estimates]) + "\n")
    page = (Path(__file__).parents[2] / HOW_TO / "evaluate.md").read_text("utf-8")
    (folder / "brightest.py").write_text(page.partition("```python brightest.py\n")[2].partition("```")[0])
    return folder


def test_covers_every_page_with_commands() -> None:
    pages = {page.removeprefix(HOW_TO) for page, _ in FOUND if page.startswith(HOW_TO)}
    assert pages - ELSEWHERE == set(PAGES)


@pytest.mark.parametrize("name", [name for name, page in PAGES.items() if "" not in page.skipped])
def test_commands_of_page_run(
    name: str, prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page, run_count = PAGES[name], 0
    for needed, source in page.needs.items():
        (tmp_path / needed).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (prepared / source).is_dir() else shutil.copy)(prepared / source, tmp_path / needed)
    monkeypatch.chdir(tmp_path)
    for words in (words for page_name, words in FOUND if page_name == HOW_TO + name):
        command = " ".join(words)
        if any(command.startswith(beginning) for beginning in page.skipped):
            continue
        for beginning, result in page.fresh.items():
            if command.startswith(beginning):
                shutil.rmtree(result, ignore_errors=True)
        added_words = [
            word for beginning, added in page.added.items() if command.startswith(beginning) for word in added.split()
        ]
        code = run(*(page.written.get(word, word) for word in words), *added_words)
        output = capsys.readouterr()
        refusal = page.refused.get(command)
        if refusal is not None:
            assert refusal in " ".join(output.err.split())
        assert code == (0 if refusal is None else 2), f"{command}: {code}\n{output.out[-2000:]}{output.err[-2000:]}"
        run_count += 1
    assert run_count
