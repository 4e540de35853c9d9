"""The command `generate` as a user meets it: what it prints, writes and returns."""

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


def call(*arguments: str) -> int:
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
    """Return a caller of the command in a folder that holds `lut` and `pictures`."""
    prepare(tmp_path)
    monkeypatch.chdir(tmp_path)
    return call


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return such a folder, for tests that leave it as it is."""
    folder = tmp_path_factory.mktemp("kept")
    prepare(folder)
    return folder


def test_what_is_odd_of_a_picture_is_noted(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    """Every picture can be used, and each looks unlike what its owner sees on a screen, or like a mistake."""
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
    assert {name: [note.split(",")[0] for note in listed] for name, listed in notes.items()} == {
        "alpha.png": ["transparent"],
        "black.png": ["all black"],
        "float.tif": ["floating-point values"],
        "tiny.png": ["tiny", "all black"],
    }
    assert generate("lut", "out", "--sources", "pictures", "--light", "0") == 0
    assert capsys.readouterr().out.count("4 pictures have notes in sources.csv, such as alpha.png: transparent") == 1


def test_lights_of_a_file_fit_the_table_or_are_refused(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    white = open_lut(Path("lut")).white
    near = white[0] / white[0].sum() + [0.0, 0.02, 0.0]
    wish = ("lut", "out", "--sources", "pictures", "--match", "gt.csv", "--json")
    rows = [white[1], white[0], white[2], white[3], near]
    Path("gt.csv").write_text("r,g,b\n\n" + "".join("{:.9f},{:.9f},{:.9f}\n".format(*row) for row in rows))
    with Path("gt.csv").open("a") as stream:
        stream.write("0,0,1\n")
    assert generate(*wish) == 2
    assert "of gt.csv lie more than 3 degrees" in (said := capsys.readouterr().err)
    assert "the first in line 8;" in said
    assert not Path("out").exists()
    Path("gt.csv").write_text(Path("gt.csv").read_text().removesuffix("0,0,1\n"))
    assert generate(*wish, "--lights-per-image", "2") == 0
    outside = json.loads(capsys.readouterr().out)["outside"]
    assert outside["count"] == 1
    assert 0.1 < outside["largest_deg"] < 3
    described = json.loads(Path("out/dataset.json").read_text())["options"]["lights"]["lights"]
    assert described["outside"] == outside


def test_a_dataset_with_its_contact_sheet(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    Path("pictures/bad.png").write_bytes(b"?")
    wish = ("--sources", "pictures", "--light", "0,2-3", "--seed", "4", "--rendering", "codes")
    wish += ("--contact-sheet", "sheet.png")
    assert generate("lut", "out", *wish, "--max-side", "30") == 0
    printed = capsys.readouterr()
    assert "out: 6 images of 2 pictures under 3 lights" in printed.out
    assert "1 of 3 pictures was left out" in printed.out
    assert "lists as unfit; they took the nearest fit colour" in printed.out
    assert "left out bad.png" in printed.err
    assert "6/6" in printed.err
    assert cv2.imread("sheet.png") is not None
    # The three lines of the package's docstring make the same image.
    lut = open_lut("lut")
    raw = render(lut, read_picture("pictures/one.png", 30), light=2, rendering="codes", seed=4, image=4)
    stored = cv2.imread("out/images/000004.png", cv2.IMREAD_UNCHANGED)
    assert stored is not None
    np.testing.assert_array_equal(stored[..., ::-1], raw)


def test_a_sheet_that_could_not_be_written_is_made_alone(
    generate: Generate, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names are no mathematics, whatever dollar signs are in them."""
    Path("pictures/two.png").rename("pictures/A$%$ US$_\\frac{$.png")
    wish = ("--sources", "pictures", "--light", "0:0.5+2:0.5", "--contact-sheet", "sheet.png")

    def full(path: Path, data: bytes) -> None:
        raise StorageError(f"cannot write {path}") from OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(contact, "write_atomic", full)
        assert generate("lut", "out", *wish) == 5
    assert (
        "error: out is complete, but its contact sheet sheet.png cannot be written: No space left on device; free "
        "space or choose another place, then make the sheet with generate --verify out --contact-sheet PATH"
    ) in capsys.readouterr().err
    assert generate("--verify", "out", "--contact-sheet", "sheet.png") == 0
    assert cv2.imread("sheet.png") is not None


def test_shares_are_finished_and_verified(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ("--sources", "pictures", "--light", "all", "--shard-images", "3", "--rendering", "codes")
    assert generate("lut", "out", *wish, "--shard", "1/2") == 0
    assert "1 of 3 shards of out are done; others are still to be made" in capsys.readouterr().out
    assert generate("lut", "out", *wish, "--shard", "0/2") == 0
    assert "3 of 3 shards of out are done; run the same command without --shard" in capsys.readouterr().out
    assert generate("lut", "out", *wish) == 0
    assert "out: 8 images of 2 pictures under 4 lights" in capsys.readouterr().out
    assert generate("--verify", "out") == 0
    assert "out: 8 images, every file as it was made" in capsys.readouterr().out
    Path("out/images/000005.png").write_bytes(b"")
    assert generate("--verify", "out") == 4
    printed = capsys.readouterr()
    assert printed.out == "images/000005.png has changed\n"
    assert "out is not as it was made: 1 fault, listed above" in printed.err


def test_who_asks_for_the_end_is_told_and_goes_on_later(
    generate: Generate, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    wish = ("--sources", "pictures", "--light", "all", "--rendering", "codes")
    with monkeypatch.context() as patched:
        patched.setattr("generator.progress._Images.advance", ended)
        assert generate("lut", "out", *wish) == 130
    assert "interrupted" in capsys.readouterr().err
    assert generate("lut", "out", *wish) == 0
    assert capsys.readouterr().err.count("were found finished") <= 1


def test_a_share_is_gone_on_with_by_the_whole(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ("--sources", "pictures", "--light", "all", "--shard-images", "3", "--rendering", "codes")
    assert generate("lut", "out", *wish, "--shard", "0/2") == 0
    assert generate("lut", "out", *wish, "--seed", "1") == 2
    assert "out was begun with another plan (seed 0, now 1)" in " ".join(capsys.readouterr().err.split())
    assert generate("lut", "out", *wish) == 0
    assert "5 images were found finished" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lut", "out"), "there is no source picture"),
        (("lut", "out", "--sources", "nowhere"), "there is no nowhere"),
        (("lut", "pictures", "--sources", "pictures"), "pictures already exists"),
        (("pictures", "out", "--sources", "pictures"), "pictures is no table"),
        (("lut", "out", "--sources", "pictures", "--nearest", "none.csv"), "cannot read ground truths none.csv"),
        (("lut", "out", "--sources", "pictures", "--seed", "-1"), "the seed is -1"),
        (("lut", "out", "--random-scenes", "1:big"), "--random-scenes is 'big'"),
        (("lut", "nowhere://out", "--sources", "pictures"), "cannot reach nowhere://out"),
        ((), "the table and the place of the dataset are missing"),
        (("lut",), "lut is the table, and the place of the dataset is missing; write generate lut OUT"),
        (("pictures",), "pictures is no table"),
        (("pictures", "lut"), "the table comes first, then the place of the dataset: generate lut pictures"),
        (("pictures", "demo:"), "generate demo: pictures"),
        (("--verify", "lut"), "lut is no dataset"),
        (("--verify", "out", "extra"), "--verify does not expect extra; leave it out"),
        (("lut", "out", "--random-scenes", "x"), "expected a number such as 8"),
        (("lut", "out", "--sources", "pictures", "--crop", "9x9,left"), "expected cover or random"),
        (("lut", "out", "--sources", "pictures", "--contact-sheet", "sheet.jpg"), "end in .png"),
        (("lut", "out", "--sources", "pictures", "--contact-sheet", "pictures/one.png"), "already exists"),
        (
            ("lut", "out", "--sources", "pictures", "--contact-sheet", "out/sheet.png"),
            "would be no part of the dataset",
        ),
        (("lut", "out", "--shard", "0/2", "--contact-sheet", "sheet.png"), "when all shares are done"),
        (("lut", "", "--sources", "pictures"), "'' names no place"),
        (("lut", "/", "--sources", "pictures"), "'/' names no place"),
        (("lut", "out", "--sources", ""), "'' names no place"),
        (("lut", "out", "--sources", "/dev/null"), "/dev/null is a device or a pipe"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(
    kept: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(kept)
    assert call(*arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert message in errors[0]
    assert not Path("out").exists()
    assert not [path for path in Path().iterdir() if path.name.startswith(".")]
