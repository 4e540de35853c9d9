"""Repeating scenes and illuminants with the LUT of another camera."""

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
    """Change to a folder with LUTs of two cameras with different numbering, and pictures, one of them damaged."""
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
    """Return the spectrum in three bands of a label."""
    illuminations = open_lut(Path(table)).illuminations
    terms = [term.partition(":") for term in label.split("+")]
    return np.sum(
        [float(weight or 1) * np.array(SPECTRA[illuminations[int(light)].colour.blue]) for light, _, weight in terms],
        axis=0,
    )


@pytest.mark.parametrize("lights", [("--random", "2"), ("--match", "gt.csv")])
def test_repeats_scenes_and_lights_for_second_camera(lab: Path, lights: tuple[str, ...]) -> None:
    del lab
    options = ("--sources", "pictures", "--no-preview")
    assert main(("one", "first", *options, *lights, "--crop", "20x16,random", "--seed", "7")) == 0
    assert main(("two", "second", *options, "--lights-of", "first")) == 0
    first, second = open_dataset("first"), open_dataset("second")
    assert [entry.image for entry in second.entries] == [entry.image for entry in first.entries]
    assert [skipped.name for skipped in second.description.skipped] == ["c.png"]
    assert second.description.options["lights"]["table_sha256"] == open_lut(Path("one")).sha256
    for first_entry, second_entry in zip(first.entries, second.entries, strict=True):
        assert first_entry.source == second_entry.source
        light = spectrum("one", first_entry.lights[0])
        assert spectrum("two", second_entry.lights[0]) == pytest.approx(light, rel=1e-8)
        for entry, dataset, camera in ((first_entry, first, "one"), (second_entry, second, "two")):
            response = CAMERAS[camera] @ light
            assert entry.truth == pytest.approx(response / response.sum(), abs=1e-4)
            # Pixels divided by the illuminant give equal reflectances, except for rounding.
            raw = dataset.read_image(entry).astype(float)
            reflected = raw / 400 @ np.linalg.inv(CAMERAS[camera]).T / light
            assert np.abs(reflected - np.clip(reflected, 0.098, 1.002)).max() < 0.01
    first_image, second_image = (
        dataset.read_image(dataset.entries[0]).astype(float) @ np.linalg.inv(CAMERAS[camera]).T
        for dataset, camera in ((first, "one"), (second, "two"))
    )
    assert first_image == pytest.approx(second_image, abs=4)


def test_third_camera_uses_first_crops(lab: Path) -> None:
    del lab
    options = ("--sources", "pictures", "--no-preview")
    crop = ("--crop", "20x16,random", "--seed", "7")
    assert main(("one", "first", *options, "--light", "all", *crop)) == 0
    assert main(("two", "second", *options, "--lights-of", "first", "--seed", "7")) == 0
    assert main(("two", "other", *options, "--lights-of", "first", "--seed", "1")) == 0
    assert main(("two", "third", *options, "--lights-of", "other", "--seed", "7")) == 0
    for entry in open_dataset("second").entries:
        second, third = (Path(name, "images", entry.image).read_bytes() for name in ("second", "third"))
        assert second == third


def test_repeats_masks(lab: Path) -> None:
    del lab
    options = ("--sources", "pictures", "--no-preview")
    assert main(("one", "first", *options, "--random", "1", "--lights-per-image", "2", "--seed", "3")) == 0
    assert main(("two", "second", *options, "--lights-of", "first")) == 0
    first, second = open_dataset("first"), open_dataset("second")
    for first_entry, second_entry in zip(first.entries, second.entries, strict=True):
        assert first.read_weights(first_entry).tolist() == second.read_weights(second_entry).tolist()


def test_refuses_masks_in_shards(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    del lab
    options = ("--sources", "pictures", "--no-preview")
    several = ("--random", "1", "--lights-per-image", "2", "--layout", "webdataset")
    assert main(("one", "first", *options, *several)) == 0
    assert main(("two", "second", *options, "--lights-of", "first")) == 2
    assert "make it with --layout folder" in capsys.readouterr().err


def test_refuses_different_lights_and_pictures(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--sources", "pictures", "--no-preview")
    assert main(("one", "first", *options, "--light", "all")) == 0
    capsys.readouterr()

    def error_of(*arguments: str) -> str:
        assert main(arguments) == 2
        assert not Path("out").exists()
        return capsys.readouterr().err

    lights_of = ("--lights-of", "first")
    assert "lacks 1 of the 4 illuminants of first: number 3 with codes 9 8 3" in error_of(
        "fewer", "out", *options, *lights_of
    )
    assert "--max-side, --crop and --crops" in error_of("two", "out", *options, *lights_of, "--max-side", "9")
    (lab / "pictures" / "b.png").rename(lab / "b.png")
    assert "1 of the 3 pictures of first are missing: b.png" in error_of("two", "out", *options, *lights_of)
    (lab / "pictures" / "a.png").rename(lab / "pictures" / "b.png")
    (lab / "b.png").rename(lab / "pictures" / "a.png")
    assert "a.png differs from the picture of the first data set" in error_of("two", "out", *options, *lights_of)


def test_repeats_random_scenes(lab: Path) -> None:
    del lab
    assert main(("one", "first", "--random-scenes", "2:12x10", "--seed", "9", "--no-preview")) == 0
    assert main(("one", "again", "--lights-of", "first", "--seed", "9", "--no-preview")) == 0
    for name in ("000000.png", "000001.png"):
        assert Path("again/images", name).read_bytes() == Path("first/images", name).read_bytes()


def test_repeats_crops_and_tints(lab: Path) -> None:
    del lab
    options = ("--sources", "pictures", "--no-preview", "--gradient", "smooth:stops=1,colour=.2")
    crops = ("--crop", "16x16", "--crops", "2")
    assert main(("one", "first", *options, *crops, "--random", "1", "--seed", "2")) == 0
    assert main(("one", "again", *options, "--lights-of", "first", "--seed", "2")) == 0
    first, repeated = open_dataset("first"), open_dataset("again")
    assert [entry.image for entry in first.entries] == [entry.image for entry in repeated.entries]
    assert len(first.entries) == 6
    for first_entry, second_entry in zip(first.entries, repeated.entries, strict=True):
        assert (first_entry.lights, first_entry.truth) == (second_entry.lights, second_entry.truth)
        assert first.read_image(first_entry).tolist() == repeated.read_image(second_entry).tolist()


def test_distinguishes_spectra_by_name(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_table(lab / "lamps", "one", (0, 1), ("FL2", "LED-B1"))
    make_table(lab / "turned", "two", (1, 0), ("LED-B1", "FL2"))
    make_table(lab / "others", "two", (1, 0), ("LED-B1", "HP1"))
    options = ("--sources", "pictures", "--no-preview")
    assert main(("lamps", "first", *options, "--light", "all")) == 0
    assert main(("turned", "second", *options, "--lights-of", "first")) == 0
    first, second = open_dataset("first"), open_dataset("second")
    assert [entry.lights for entry in first.entries[:2]] == [("0",), ("1",)]
    assert [entry.lights for entry in second.entries[:2]] == [("1",), ("0",)]
    capsys.readouterr()
    assert main(("others", "third", *options, "--lights-of", "first")) == 2
    assert "lacks 1 of the 2 illuminants of first: number 0 called FL2 with codes 9 8 7" in capsys.readouterr().err


@pytest.mark.parametrize("lights", [("--light", "0:.5+1:.5"), ("--random", "1", "--lights-per-image", "2")])
def test_refuses_mixtures_of_spectra(lab: Path, capsys: pytest.CaptureFixture[str], lights: tuple[str, ...]) -> None:
    make_table(lab / "lamps", "one", (0, 1), ("FL2", "LED-B1"))
    make_table(lab / "same", "two", (0, 1), ("FL2", "LED-B1"))
    options = ("--sources", "pictures", "--no-preview")
    assert main(("lamps", "first", *options, *lights)) == 0
    assert main(("lamps", "again", *options, "--lights-of", "first")) == 0
    capsys.readouterr()
    assert main(("same", "second", *options, "--lights-of", "first")) == 2
    assert "mix spectra with separate exposures" in " ".join(capsys.readouterr().err.split())
