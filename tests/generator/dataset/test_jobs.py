"""Datasets that are asked for twice."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from generator import open_lut
from generator.cli import main
from generator.dataset.making import generate_dataset
from generator.dataset.reader import Dataset
from generator.pictures.sources import find_pictures
from tests.generator.conftest import MakeLut

if TYPE_CHECKING:
    from calibration.table.lut import Lut


@pytest.fixture
def lut(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lut:
    """Return a table of 512 colours, and go to the folder that holds it and a folder of six pictures."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pictures").mkdir()
    for number in range(6):
        codes = np.random.default_rng(number).integers(0, 256, (24, 30 + number, 3)).astype(np.uint8)
        cv2.imwrite(f"pictures/{number}.png", codes)
    return make_lut(bits=3)


class TestAskedForTwice:
    WISH = ("--sources", "pictures", "--seed", "2", "--rendering", "codes")

    @pytest.mark.slow
    def test_it_says_so_and_nothing_is_touched(self, lut: Lut, capsys: pytest.CaptureFixture[str]) -> None:
        wish = (*self.WISH, "--contact-sheet", "sheet.png")
        assert main(("lut", "out", *wish)) == 0
        before = {path: path.stat().st_mtime_ns for path in Path("out").rglob("*")}
        capsys.readouterr()
        assert main(("lut", "out", *wish)) == 0
        printed = capsys.readouterr().out
        assert "out: 6 images of 6 pictures under" in printed
        assert "complete already; nothing was made" in printed
        assert "sheet.png: a contact sheet is there already" in printed
        assert {path: path.stat().st_mtime_ns for path in Path("out").rglob("*")} == before

    @pytest.mark.slow
    def test_pictures_that_changed_since_are_found(self, lut: Lut, capsys: pytest.CaptureFixture[str]) -> None:
        """Whatever the time that a copy brings with it."""
        assert main(("lut", "out", *self.WISH)) == 0
        os.utime("out/dataset.json", (1_000_000_000, 1_000_000_000))
        assert main(("lut", "out", *self.WISH)) == 0, "written to, and the same"
        data = Path("pictures/4.png").read_bytes()
        shutil.copy("pictures/5.png", "pictures/4.png")
        os.utime("pictures/4.png", (900_000_000, 900_000_000))
        assert main(("lut", "out", *self.WISH)) == 2
        assert "otherwise (the content of 4.png)" in capsys.readouterr().err
        Path("pictures/4.png").write_bytes(data)
        assert main(("lut", "out", *self.WISH)) == 0
        Path("pictures/4.png").rename("pictures/9.png")
        assert main(("lut", "out", *self.WISH)) == 2
        assert "source 4 4.png, now 5.png" in capsys.readouterr().err

    def test_what_is_no_dataset_is_in_the_way_still(self, lut: Lut, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(("lut", "pictures", "--sources", "pictures")) == 2
        assert "pictures already exists" in capsys.readouterr().err

    @pytest.mark.slow
    def test_of_another_table_too(self, lut: Lut, make_lut: MakeLut, capsys: pytest.CaptureFixture[str]) -> None:
        made: Dataset = generate_dataset(lut, "out", find_pictures("pictures"), [0])
        assert made.description.images == 6
        make_lut(bits=2, name="other")
        assert open_lut("other").sha256 != lut.sha256
        assert main(("other", "out", "--sources", "pictures", "--light", "0")) == 2
        assert "table sha256" in capsys.readouterr().err
