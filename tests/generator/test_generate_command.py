"""The command `generate` as a user meets it: what it prints, writes and returns."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from generator import open_lut, read_picture, render
from generator.cli import main
from generator.dataset import open_dataset

if TYPE_CHECKING:
    from collections.abc import Callable

    from calibration.lut import Lut

    Generate = Callable[..., int]


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch, make_lut: Callable[..., Lut], tmp_path: Path) -> Generate:
    """Return a caller of the command in a folder that holds `lut` and `pictures`."""
    make_lut(unfit=(0,))
    (tmp_path / "pictures").mkdir()
    for name, size in (("one.png", (40, 60)), ("two.png", (30, 20))):
        codes = np.random.default_rng(size[0]).integers(0, 256, (*size, 3))
        (tmp_path / "pictures" / name).write_bytes(cv2.imencode(".png", codes.astype(np.uint8))[1].tobytes())
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["generate", *arguments])
        return main()

    return call


def test_a_dataset_with_its_contact_sheet(generate: Generate, capsys: pytest.CaptureFixture[str]) -> None:
    Path("pictures/bad.png").write_bytes(b"?")
    wish = ("--sources", "pictures", "--illuminations", "0,2-3", "--seed", "4", "--contact-sheet", "sheet.png")
    assert generate("lut", "out", *wish, "--max-side", "30") == 0
    printed = capsys.readouterr()
    assert "out: 6 images of 2 pictures under 3 lights" in printed.out
    assert "1 of 3 pictures could not be read" in printed.out
    assert "lists as unfit; they took the nearest fit colour" in printed.out
    assert "passed over bad.png" in printed.err
    assert "6/6" in printed.err
    assert cv2.imread("sheet.png") is not None
    described = json.loads(Path("out/dataset.json").read_text())
    assert described["options"] == {
        "format": "png",
        "layout": "folder",
        "max_side": 30,
        "profiles": "honour",
        "lights": {"choice": "listed", "lights": [0, 2, 3]},
        "previews": True,
        "split": None,
        "shard_images": 256,
    }
    # The three lines of the package's docstring make the same image.
    lut = open_lut("lut")
    raw = render(lut, read_picture("pictures/one.png", 30), light=2, seed=4, image=4)
    stored = cv2.imread("out/images/000004.png", cv2.IMREAD_UNCHANGED)
    assert stored is not None
    np.testing.assert_array_equal(stored[..., ::-1], raw)


def test_random_and_nearest_lights_and_random_scenes(generate: Generate) -> None:
    assert generate("lut", "a", "--sources", "pictures/one.png", "--random", "3", "--format", "tiff") == 0
    assert len(list(Path("a/images").glob("*.tiff"))) == 3
    truth = open_lut("lut").white[3]
    Path("gt.txt").write_text("{} {} {}\n".format(*truth))
    assert generate("lut", "b", "--random-scenes", "2", "--size", "33x21", "--nearest", "gt.txt", "--no-preview") == 0
    described = json.loads(Path("b/dataset.json").read_text())
    assert [light["illumination"] for light in described["lights"]] == [3]
    assert described["options"]["lights"]["choice"] == "nearest"
    assert described["options"]["lights"]["file"] == "gt.txt"
    assert [(source.width, source.height) for source in open_dataset(Path("b")).sources] == [(33, 21)] * 2
    assert generate("lut", "c", "--sources", "pictures") == 0
    assert json.loads(Path("c/dataset.json").read_text())["options"]["lights"] == {"choice": "random", "count": 1}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lut", "out"), "there is no source picture"),
        (("lut", "out", "--sources", "nowhere"), "there is no nowhere"),
        (("lut", "pictures", "--sources", "pictures"), "pictures already exists"),
        (("pictures", "out", "--sources", "pictures"), "pictures is no table"),
        (("lut", "out", "--sources", "pictures", "--illuminations", "0,7"), "there is no light 7"),
        (("lut", "out", "--sources", "pictures", "--random", "5"), "the table has 4"),
        (("lut", "out", "--sources", "pictures", "--nearest", "none.csv"), "cannot read ground truths none.csv"),
        (("lut", "out", "--sources", "pictures", "--seed", "-1"), "the seed is -1"),
        (("lut", "out", "--random-scenes", "1", "--size", "big"), "--size is 'big'"),
        (("lut", "out", "--sources", "pictures", "--random", "1", "--illuminations", "0"), "choose lights in one way"),
        (("lut", "out", "--sources", "pictures", "--workers", "0"), "0 workers"),
        (("lut", "out", "--sources", "pictures", "--contact-sheet", "sheet.jpg"), "end in .png"),
        (("lut", "out", "--sources", "pictures", "--contact-sheet", "pictures/one.png"), "already exists"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(
    generate: Generate, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    assert generate(*arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert message in errors[0]
    assert not Path("out").exists()
    assert not [path for path in Path().iterdir() if path.name.startswith(".")]
