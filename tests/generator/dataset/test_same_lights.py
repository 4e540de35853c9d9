"""The scenes and lights of a dataset for the table of another camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from calibration.table.lut import open_lut
from generator.cli import main
from generator.dataset.reader import open_dataset
from tests.generator.dataset.two_cameras import CAMERAS, SPECTRA, make_table

pytestmark = pytest.mark.slow


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Go to a folder with tables of two cameras, whose lights have other numbers, and pictures, one of them damaged."""
    make_table(tmp_path / "one", "one", (0, 1, 2, 3))
    make_table(tmp_path / "two", "two", (3, 1, 0, 2))
    make_table(tmp_path / "fewer", "two", (0, 1, 2))
    (tmp_path / "pictures").mkdir()
    for name in ("a", "b", "d"):
        codes = np.random.default_rng(ord(name)).integers(0, 256, (40, 30, 3)).astype(np.uint8)
        (tmp_path / "pictures" / f"{name}.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    (tmp_path / "pictures" / "c.png").write_bytes(b"?")
    (tmp_path / "gt.csv").write_text("r,g,b\n.42,.36,.22\n.3,.4,.3\n.35,.38,.27\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def spectrum(table: str, label: str) -> npt.NDArray[np.float64]:
    """Return the light in three bands that a label of a dataset is."""
    shown = open_lut(Path(table)).illuminations
    parts = [part.partition(":") for part in label.split("+")]
    return np.sum(
        [float(weight or 1) * np.array(SPECTRA[shown[int(light)].colour.blue]) for light, _, weight in parts], axis=0
    )


@pytest.mark.parametrize("lights", [("--random", "2"), ("--match", "gt.csv")])
def test_both_cameras_see_the_same_scenes_under_the_same_light(lab: Path, lights: tuple[str, ...]) -> None:
    del lab
    wish = ("--sources", "pictures", "--no-preview")
    assert main(("one", "first", *wish, *lights, "--crop", "20x16,random", "--seed", "7")) == 0
    assert main(("two", "second", *wish, "--lights-of", "first")) == 0
    first, second = open_dataset("first"), open_dataset("second")
    assert [entry.image for entry in second.entries] == [entry.image for entry in first.entries]
    assert [skipped.name for skipped in second.description.skipped] == ["c.png"]
    assert second.description.options["lights"]["table_sha256"] == open_lut(Path("one")).sha256
    for here, there in zip(first.entries, second.entries, strict=True):
        assert here.source == there.source
        light = spectrum("one", here.lights[0])
        assert spectrum("two", there.lights[0]) == pytest.approx(light, rel=1e-8)
        for entry, dataset, camera in ((here, first, "one"), (there, second, "two")):
            seen = CAMERAS[camera] @ light
            assert entry.truth == pytest.approx(seen / seen.sum(), abs=1e-4)
            # Pixels are the same reflectances under the same light: divided back they agree within rounding.
            raw = dataset.read_image(entry).astype(float)
            reflected = raw / 400 @ np.linalg.inv(CAMERAS[camera]).T / light
            assert np.abs(reflected - np.clip(reflected, 0.098, 1.002)).max() < 0.01
    one, two = (
        dataset.read_image(dataset.entries[0]).astype(float) @ np.linalg.inv(CAMERAS[camera]).T
        for dataset, camera in ((first, "one"), (second, "two"))
    )
    assert one == pytest.approx(two, abs=4)


def test_pictures_of_a_third_camera_are_cut_as_for_the_first(lab: Path) -> None:
    del lab
    wish = ("--sources", "pictures", "--no-preview")
    cut = ("--crop", "20x16,random", "--seed", "7")
    assert main(("one", "first", *wish, "--light", "all", *cut)) == 0
    assert main(("two", "second", *wish, "--lights-of", "first", "--seed", "7")) == 0
    assert main(("two", "other", *wish, "--lights-of", "first", "--seed", "1")) == 0
    assert main(("two", "third", *wish, "--lights-of", "other", "--seed", "7")) == 0
    for entry in open_dataset("second").entries:
        second, third = (Path(name, "images", entry.image).read_bytes() for name in ("second", "third"))
        assert second == third


def test_masks_are_those_of_the_first(lab: Path) -> None:
    del lab
    wish = ("--sources", "pictures", "--no-preview")
    assert main(("one", "first", *wish, "--random", "1", "--lights-per-image", "2", "--seed", "3")) == 0
    assert main(("two", "second", *wish, "--lights-of", "first")) == 0
    first, second = open_dataset("first"), open_dataset("second")
    for here, there in zip(first.entries, second.entries, strict=True):
        assert first.read_weights(here).tolist() == second.read_weights(there).tolist()


def test_masks_that_lie_in_shards_are_refused(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    del lab
    wish = ("--sources", "pictures", "--no-preview")
    several = ("--random", "1", "--lights-per-image", "2", "--layout", "webdataset")
    assert main(("one", "first", *wish, *several)) == 0
    assert main(("two", "second", *wish, "--lights-of", "first")) == 2
    assert "layout webdataset; make it in the layout folder" in capsys.readouterr().err


def test_what_is_refused(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ("--sources", "pictures", "--no-preview")
    assert main(("one", "first", *wish, "--light", "all")) == 0
    capsys.readouterr()

    def refused(*arguments: str) -> str:
        assert main(arguments) == 2
        assert not Path("out").exists()
        return capsys.readouterr().err

    of = ("--lights-of", "first")
    assert "lacks 1 of the 4 lights of first: number 3 of codes 9 8 3" in refused("fewer", "out", *wish, *of)
    assert "--max-side, --crop and --crops" in refused("two", "out", *wish, *of, "--max-side", "9")
    (lab / "pictures" / "b.png").rename(lab / "b.png")
    assert "1 of the 3 pictures of first are not found: b.png" in refused("two", "out", *wish, *of)
    (lab / "pictures" / "a.png").rename(lab / "pictures" / "b.png")
    (lab / "b.png").rename(lab / "pictures" / "a.png")
    assert "a.png is not the picture that the dataset was made of" in refused("two", "out", *wish, *of)


def test_random_scenes_are_made_again(lab: Path) -> None:
    del lab
    assert main(("one", "first", "--random-scenes", "2:12x10", "--seed", "9", "--no-preview")) == 0
    assert main(("one", "again", "--lights-of", "first", "--seed", "9", "--no-preview")) == 0
    for name in ("000000.png", "000001.png"):
        assert Path("again/images", name).read_bytes() == Path("first/images", name).read_bytes()


def test_crops_and_tints_are_scenes_of_one_light(lab: Path) -> None:
    del lab
    wish = ("--sources", "pictures", "--no-preview", "--gradient", "smooth:stops=1,colour=.2")
    crops = ("--crop", "16x16", "--crops", "2")
    assert main(("one", "first", *wish, *crops, "--random", "1", "--seed", "2")) == 0
    assert main(("one", "again", *wish, "--lights-of", "first", "--seed", "2")) == 0
    first, again = open_dataset("first"), open_dataset("again")
    assert [entry.image for entry in first.entries] == [entry.image for entry in again.entries]
    assert len(first.entries) == 6
    for here, there in zip(first.entries, again.entries, strict=True):
        assert (here.lights, here.truth) == (there.lights, there.truth)
        assert first.read_image(here).tolist() == again.read_image(there).tolist()


def test_spectra_of_one_colour_are_told_by_their_names(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_table(lab / "lamps", "one", (0, 1), ("FL2", "LED-B1"))
    make_table(lab / "turned", "two", (1, 0), ("LED-B1", "FL2"))
    make_table(lab / "others", "two", (1, 0), ("LED-B1", "HP1"))
    wish = ("--sources", "pictures", "--no-preview")
    assert main(("lamps", "first", *wish, "--light", "all")) == 0
    assert main(("turned", "second", *wish, "--lights-of", "first")) == 0
    first, second = open_dataset("first"), open_dataset("second")
    assert [entry.lights for entry in first.entries[:2]] == [("0",), ("1",)]
    assert [entry.lights for entry in second.entries[:2]] == [("1",), ("0",)]
    capsys.readouterr()
    assert main(("others", "third", *wish, "--lights-of", "first")) == 2
    assert "lacks 1 of the 2 lights of first: number 0 called FL2 of codes 9 8 7" in capsys.readouterr().err


@pytest.mark.parametrize("lights", [("--light", "0:.5+1:.5"), ("--random", "1", "--lights-per-image", "2")])
def test_mixtures_of_spectra_are_refused_for_another_camera(
    lab: Path, capsys: pytest.CaptureFixture[str], lights: tuple[str, ...]
) -> None:
    make_table(lab / "lamps", "one", (0, 1), ("FL2", "LED-B1"))
    make_table(lab / "same", "two", (0, 1), ("FL2", "LED-B1"))
    wish = ("--sources", "pictures", "--no-preview")
    assert main(("lamps", "first", *wish, *lights)) == 0
    assert main(("lamps", "again", *wish, "--lights-of", "first")) == 0
    capsys.readouterr()
    assert main(("same", "second", *wish, "--lights-of", "first")) == 2
    assert "their proportion is not known" in " ".join(capsys.readouterr().err.split())
