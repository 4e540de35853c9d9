"""The command `generate`: output, files and exit codes."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from foundation.errors import StorageError
from generator import open_lut, read_picture, render
from generator.cli import main
from generator.dataset import contact_sheet as contact
from tests.generator.conftest import lut_in

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from collections.abc import Callable

    Generate = Callable[..., int]


def run_generate(*arguments: str) -> int:
    return main(arguments)


def prepare(folder: Path) -> None:
    """Make `lut` and `pictures` in a folder."""
    lut_in(folder / "lut", unfit=(0,))
    (folder / "pictures").mkdir()
    for name, size in (("one.png", (40, 60)), ("two.png", (30, 20))):
        codes = np.random.default_rng(size[0]).integers(0, 256, (*size, 3))
        (folder / "pictures" / name).write_bytes(cv2.imencode(".png", codes.astype(np.uint8))[1].tobytes())


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Generate:
    """Return a function that runs the command in a folder with `lut` and `pictures`."""
    prepare(tmp_path)
    monkeypatch.chdir(tmp_path)
    return run_generate


@pytest.fixture(scope="module")
def prepared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `lut` and `pictures`, for tests that do not change it."""
    folder = tmp_path_factory.mktemp("kept")
    prepare(folder)
    return folder


def test_notes_unusual_pictures(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    Path("pictures/two.png").unlink()
    cv2.imwrite("pictures/alpha.png", np.full((20, 20, 4), 90, np.uint8))
    cv2.imwrite("pictures/black.png", np.zeros((20, 20, 3), np.uint8))
    cv2.imwrite("pictures/float.tif", np.full((20, 20, 3), 0.5, np.float32))
    cv2.imwrite("pictures/tiny.png", np.zeros((20, 15, 3), np.uint8))
    assert generate("lut", "out", "--sources", "pictures", "--light", "0", "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["noted"] == 4
    with Path("out/sources.csv").open(newline="") as stream:
        notes = {row["name"]: row["note"].split("; ") for row in csv.DictReader(stream)}
    assert notes.pop("one.png") == [""]
    assert {name: [note.split(",")[0] for note in texts] for name, texts in notes.items()} == {
        "alpha.png": ["transparent"],
        "black.png": ["all black"],
        "float.tif": ["floating-point values"],
        "tiny.png": ["tiny", "all black"],
    }
    assert generate("lut", "out", "--sources", "pictures", "--light", "0") == 0
    assert (
        capsys.readouterr().out.count("4 pictures have notes in sources.csv, for example alpha.png: transparent") == 1
    )


def test_matches_ground_truths_of_file_or_refuses_them(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    white = open_lut(Path("lut")).white
    near = white[0] / white[0].sum() + [0.0, 0.02, 0.0]
    options = ("lut", "out", "--sources", "pictures", "--match", "gt.csv", "--json")
    rows = [white[1], white[0], white[2], white[3], near]
    Path("gt.csv").write_text("r,g,b\n\n" + "".join("{:.9f},{:.9f},{:.9f}\n".format(*row) for row in rows))
    with Path("gt.csv").open("a") as stream:
        stream.write("0,0,1\n")
    assert generate(*options) == 2
    assert "of gt.csv are more than 3 degrees" in (error_text := capsys.readouterr().err)
    assert "first in line 8" in error_text
    assert not Path("out").exists()
    Path("gt.csv").write_text(Path("gt.csv").read_text().removesuffix("0,0,1\n"))
    assert generate(*options, "--lights-per-image", "2") == 0
    outside = json.loads(capsys.readouterr().out)["outside"]
    assert outside["count"] == 1
    assert 0.1 < outside["largest_deg"] < 3
    described = json.loads(Path("out/dataset.json").read_text())["options"]["lights"]["lights"]
    assert described["outside"] == outside


def test_makes_data_set_with_contact_sheet(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    Path("pictures/bad.png").write_bytes(b"?")
    options = ("--sources", "pictures", "--light", "0,2-3", "--seed", "4", "--rendering", "codes")
    options += ("--contact-sheet", "sheet.png")
    assert generate("lut", "out", *options, "--max-side", "30") == 0
    printed = capsys.readouterr()
    assert "out: 6 images of 2 pictures under 3 illuminants" in printed.out
    assert "1 of 3 pictures was skipped" in printed.out
    assert "lists as unfit; they were replaced by the nearest usable colour" in printed.out
    assert "skipped bad.png" in printed.err
    assert "6/6" in printed.err
    assert cv2.imread("sheet.png") is not None
    # The example in the docstring of the package gives the same image.
    lut = open_lut("lut")
    raw = render(lut, read_picture("pictures/one.png", 30), light=2, rendering="codes", seed=4, image=4)
    stored = cv2.imread("out/images/000004.png", cv2.IMREAD_UNCHANGED)
    assert stored is not None
    np.testing.assert_array_equal(stored[..., ::-1], raw)


def test_contact_sheet_is_made_after_failure(
    generate: Generate, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Matplotlib must not parse dollar signs in names as formulas.
    Path("pictures/two.png").rename("pictures/A$%$ US$_\\frac{$.png")
    options = ("--sources", "pictures", "--light", "0:0.5+2:0.5", "--contact-sheet", "sheet.png")

    def raise_disk_full(path: Path, data: bytes) -> None:
        raise StorageError(f"cannot write {path}") from OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(contact, "write_atomic", raise_disk_full)
        assert generate("lut", "out", *options) == 5
    assert (
        "error: out is complete, but its contact sheet sheet.png cannot be written: No space left on device; free "
        "space or choose another path, then make the sheet with generate --verify out --contact-sheet PATH"
    ) in capsys.readouterr().err
    assert generate("--verify", "out", "--contact-sheet", "sheet.png") == 0
    assert cv2.imread("sheet.png") is not None


def test_completes_and_verifies_shares(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--sources", "pictures", "--light", "all", "--shard-images", "3", "--rendering", "codes")
    assert generate("lut", "out", *options, "--shard", "1/2") == 0
    assert "1 of 3 shards of out are done; run the same command with the other shares" in capsys.readouterr().out
    assert generate("lut", "out", *options, "--shard", "0/2") == 0
    assert "3 of 3 shards of out are done; run the same command without --shard" in capsys.readouterr().out
    assert generate("lut", "out", *options) == 0
    assert "out: 8 images of 2 pictures under 4 illuminants" in capsys.readouterr().out
    assert generate("--verify", "out") == 0
    assert "out: 8 images, all files are unchanged" in capsys.readouterr().out
    Path("out/images/000005.png").write_bytes(b"")
    assert generate("--verify", "out") == 4
    printed = capsys.readouterr()
    assert printed.out == "images/000005.png has changed\n"
    assert "out has 1 fault, listed above" in printed.err


def test_resumes_after_interruption(
    generate: Generate, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def terminate(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    options = ("--sources", "pictures", "--light", "all", "--rendering", "codes")
    with monkeypatch.context() as patched:
        patched.setattr("generator.progress._ImageCounter.advance", terminate)
        assert generate("lut", "out", *options) == 130
    assert "interrupted" in capsys.readouterr().err
    assert generate("lut", "out", *options) == 0
    assert capsys.readouterr().err.count("exist from an earlier run") <= 1


def test_complete_run_reuses_shares(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--sources", "pictures", "--light", "all", "--shard-images", "3", "--rendering", "codes")
    assert generate("lut", "out", *options, "--shard", "0/2") == 0
    assert generate("lut", "out", *options, "--seed", "1") == 2
    assert "out was started with another plan (seed 0, now 1)" in " ".join(capsys.readouterr().err.split())
    assert generate("lut", "out", *options) == 0
    assert "5 images exist from an earlier run" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lut", "out"), "there are no source pictures"),
        (("lut", "out", "--sources", "nowhere"), "nowhere does not exist"),
        (("lut", "pictures", "--sources", "pictures"), "pictures already exists"),
        (("pictures", "out", "--sources", "pictures"), "lut.json"),
        (("lut", "out", "--sources", "pictures", "--nearest", "none.csv"), "cannot read ground truths none.csv"),
        (("lut", "out", "--sources", "pictures", "--seed", "-1"), "the seed is -1"),
        (("lut", "out", "--random-scenes", "1:big"), "--random-scenes is 'big'"),
        (("lut", "nowhere://out", "--sources", "pictures"), "cannot open the store nowhere://out"),
        ((), "the arguments LUT and OUT are missing"),
        (("lut",), "lut is the LUT; the argument OUT is missing; run generate lut OUT"),
        (("pictures",), "pictures is not a LUT"),
        (("pictures", "lut"), "give the LUT first: generate lut pictures"),
        (("pictures", "demo:"), "generate demo: pictures"),
        (("--verify", "lut"), "lut is not a data set"),
        (("--verify", "out", "extra"), "--verify takes no LUT, but extra is given; omit it"),
        (("lut", "out", "--random-scenes", "x"), "expected a number such as 8"),
        (("lut", "out", "--sources", "pictures", "--crop", "9x9,left"), "expected cover or random"),
        (("lut", "out", "--sources", "pictures", "--contact-sheet", "sheet.jpg"), "ends in .png"),
        (("lut", "out", "--sources", "pictures", "--contact-sheet", "pictures/one.png"), "already exists"),
        (
            ("lut", "out", "--sources", "pictures", "--contact-sheet", "out/sheet.png"),
            "is inside the data set",
        ),
        (("lut", "out", "--shard", "0/2", "--contact-sheet", "sheet.png"), "in the last run"),
        (("lut", "", "--sources", "pictures"), "'' is not a folder name"),
        (("lut", "/", "--sources", "pictures"), "'/' is not a folder name"),
        (("lut", "out", "--sources", ""), "'' is not a folder name"),
        (("lut", "out", "--sources", "/dev/null"), "/dev/null is a device or a pipe"),
    ],
)
def test_reports_error_in_one_line(
    prepared_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(prepared_folder)
    assert run_generate(*arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert message in errors[0]
    assert not Path("out").exists()
    assert not [path for path in Path().iterdir() if path.name.startswith(".")]
