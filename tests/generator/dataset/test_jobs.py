"""Datasets of fewer bits, of counts stretched over 16 bits, in parts of exact sizes, and asked for twice."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import cv2
import numpy as np
import pytest

from evaluation.datasets.generated import open_generated
from foundation.errors import InputError
from generator import open_lut, read_picture, render
from generator.cli import main
from generator.dataset.making import generate_dataset
from generator.dataset.plan import exact_parts, sizes_of
from generator.dataset.reader import Dataset, open_dataset
from generator.dataset.records import Layout
from generator.files import FULL, from_full_scale, to_full_scale
from generator.pictures.random_scenes import random_scenes
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


class TestBits:
    @pytest.mark.slow
    def test_the_pictures_print_is_that_of_its_reduced_codes(self, lut: Lut) -> None:
        assert main(("lut", "out", "--sources", "pictures", "--illuminations", "1", "--bits", "2", "--seed", "3")) == 0
        dataset = open_dataset("out")
        assert dataset.description.options["bits"] == 2
        for number, entry in enumerate(dataset.entries):
            reduced = read_picture(f"pictures/{number}.png") & np.uint8(0b11000000)
            expected = render(lut, reduced, light=1, seed=3, image=number)
            np.testing.assert_array_equal(dataset.read_image(entry), expected)
        assert "2 bits a channel" in open_generated("out").treatment["bits"]

    @pytest.mark.slow
    def test_all_bits_of_the_table_change_nothing(self, lut: Lut) -> None:
        by_codes = ("--rendering", "codes")
        for name, more in (("plain", ()), ("all", ("--bits", "3"))):
            assert main(("lut", name, "--sources", "pictures", *by_codes, *more)) == 0
        assert Path("plain/images/000003.png").read_bytes() == Path("all/images/000003.png").read_bytes()
        assert "bits" not in open_dataset("plain").description.options


class TestFullScale:
    @pytest.mark.parametrize("white", [1, 2, 4095, 11536, 32768, 65534, 65535])
    def test_no_count_is_lost(self, white: int) -> None:
        counts = np.arange(white + 1, dtype=np.uint16)
        stretched = to_full_scale(counts, white)
        assert (stretched[0], stretched[-1]) == (0, FULL)
        assert np.abs(stretched - counts * (FULL / white)).max() <= 0.5 + 1e-6
        np.testing.assert_array_equal(from_full_scale(stretched, white), counts)

    @pytest.mark.slow
    @pytest.mark.parametrize("layout", get_args(Layout))
    def test_our_readers_read_what_was_stretched_as_it_was(self, lut: Lut, layout: str) -> None:
        if layout == "parquet":
            pytest.importorskip("pyarrow")
        wish = ("--sources", "pictures", "--layout", layout, "--seed", "2", "--rendering", "codes")
        assert main(("lut", "plain", *wish)) == 0
        assert main(("lut", "full", *wish, "--scale", "full")) == 0
        plain, full = open_dataset("plain"), open_dataset("full")
        white = plain.description.table.white_level
        assert (plain.description.version, full.description.version) == (2, 3)
        for one, other in zip(plain.entries, full.entries, strict=True):
            np.testing.assert_array_equal(plain.read_image(one), full.read_image(other))
            assert plain.read_preview(one) == full.read_preview(other)
        (scene, *_), (expected, *_) = open_generated("full").scenes, open_generated("plain").scenes
        assert scene.saturation == expected.saturation == white
        np.testing.assert_array_equal(scene.read()[0], expected.read()[0])
        assert "undone" in open_generated("full").treatment["scale"]
        if layout == "folder":
            stored = cv2.imread("full/images/000000.png", cv2.IMREAD_UNCHANGED)
            assert stored is not None
            np.testing.assert_array_equal(stored[..., ::-1], to_full_scale(plain.read_image(plain.entries[0]), white))
            assert b'"white_level": 65535' in Path("full/images/000000.png").read_bytes()
        else:
            assert f"{white} is white here" in Path("plain/README.md").read_text()
            assert f"round(v * {white} / 65535)" in Path("full/README.md").read_text()


class TestExactSplit:
    @pytest.mark.parametrize(("count", "sizes"), [(1, (1, 0, 0)), (7, (5, 1, 1)), (1000, (800, 100, 100))])
    def test_parts_have_exactly_the_sizes(self, count: int, sizes: tuple[int, int, int]) -> None:
        assert sizes_of(count, (0.8, 0.1, 0.1)) == sizes
        parts = exact_parts(random_scenes(count, 2, 2), (0.8, 0.1, 0.1), 4)
        assert tuple(Counter(parts)[part] for part in ("train", "validation", "test")) == sizes

    def test_a_share_that_should_be_whole_is_rounded_as_one(self) -> None:
        """0.7 · 12 and 0.2 · 12 leave the same remainder; as floating-point numbers the second leaves more."""
        assert sizes_of(12, (0.7, 0.2, 0.1)) == (9, 2, 1)

    def test_another_seed_divides_otherwise(self) -> None:
        scenes = random_scenes(50, 2, 2)
        one, other = (exact_parts(scenes, (0.5, 0.2, 0.3), seed) for seed in (1, 2))
        assert one != other
        assert one == exact_parts(scenes, (0.5, 0.2, 0.3), 1)

    def test_copies_stay_together(self, lut: Lut) -> None:
        """Also under other names, and also where another file is as long."""
        for copy in range(2):
            shutil.copy("pictures/0.png", f"pictures/copy{copy}.png")
        data = Path("pictures/0.png").read_bytes()
        Path("pictures/as_long.png").write_bytes(bytes(len(data)))
        sources = find_pictures("pictures")
        for seed in range(20):
            parts = dict(
                zip((source.name for source in sources), exact_parts(sources, (0.4, 0.3, 0.3), seed), strict=True)
            )
            assert len({parts[name] for name in ("0.png", "copy0.png", "copy1.png")}) == 1
            assert Counter(parts.values()) == {"train": 3, "validation": 3, "test": 3}
        some = [source for source in sources if source.name.startswith(("0", "1", "2", "3", "copy"))]
        # Three copies fit into the part of three alone, and have it before others.
        for seed in range(20):
            assert Counter(exact_parts(some, (1 / 2, 1 / 3, 1 / 6), seed)) == {"train": 3, "validation": 2, "test": 1}
        with pytest.raises(InputError, match=r"3.*2,2,2"):
            exact_parts(some, (1 / 3, 1 / 3, 1 / 3), 1)

    @pytest.mark.slow
    def test_datasets_are_divided_so_in_every_layout_and_share(self, lut: Lut) -> None:
        wish = ("--sources", "pictures", "--random", "2", "--split", "3,1,2", "--exact-split", "--shard-images", "5")
        wish += ("--rendering", "codes", "--no-preview")
        assert main(("lut", "whole", *wish)) == 0
        whole = open_dataset("whole")
        assert whole.description.splits == {"train": 6, "validation": 2, "test": 4}
        assert whole.description.options["split_exact"] is True
        for share in ("0/2", "1/2"):
            assert main(("lut", "tar", *wish, "--layout", "webdataset", "--shard", share)) == 0
        assert main(("--finish", "tar")) == 0
        assert [entry.split for entry in open_dataset("tar").entries] == [entry.split for entry in whole.entries]
        for source in {entry.source for entry in whole.entries}:
            assert len({entry.split for entry in whole.entries if entry.source == source}) == 1


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
        assert main(("--finish", "out")) == 0
        assert "complete already" in capsys.readouterr().out

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
        assert main(("other", "out", "--sources", "pictures", "--illuminations", "0")) == 2
        assert "table sha256" in capsys.readouterr().err
