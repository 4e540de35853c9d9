"""Forecasts are compared with the data sets that are made afterwards."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import pytest
from skimage import data
from tifffile import imwrite

from generator.dataset.records import Layout

pytestmark = pytest.mark.slow


def generate(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    capsys.readouterr()
    assert import_module("generator.cli").main([*map(str, arguments), "--json", "--workers", "2"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def photographs(table_and_picture: Path) -> Path:
    """Return a folder with two photographs, and a file that is no picture."""
    folder = table_and_picture / "photographs"
    folder.mkdir()
    for name in ("astronaut", "coffee"):
        imwrite(folder / f"{name}.tif", getattr(data, name)(), photometric="rgb")
    (folder / "broken.png").write_bytes(b"no picture")
    return folder


CASES: dict[str, Sequence[object]] = {
    **{layout: ("--layout", layout) for layout in get_args(Layout)},
    "crops": ("--crop", "64x64", "--crops", 5, "--no-preview", "--black-point", "compensate"),
    "masks": ("--light", "0,1", "--lights-per-image", 2, "--format", "tiff", "--max-side", 200),
    "random": ("--random-scenes", "2:40x30", "--random", 3),
}


@pytest.mark.parametrize("case", CASES)
def test_forecast_is_near_the_data_set(
    photographs: Path, tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("lut", tmp_path / "out", "--sources", photographs, *CASES[case])
    if case in get_args(Layout):
        arguments = (*arguments, "--light", "all")
    before = files(tmp_path)
    forecast = generate(capsys, *arguments, "--dry-run")
    assert files(tmp_path) == before
    made = generate(capsys, *arguments)
    assert (forecast["images"], len(forecast["skipped"])) == (made["images"], 1)
    assert forecast["outside_gamut"] == pytest.approx(made["rendering"]["outside"], abs=2e-6)
    assert forecast["colour_error_deg"] == pytest.approx(made["rendering"]["distance"], abs=2e-6)
    size = sum(path.stat().st_size for path in files(tmp_path / "out"))
    assert forecast["needed_bytes"] == pytest.approx(size, rel=0.05, abs=20_000)
    assert forecast["free_bytes"] > 0
    assert forecast["time_s"] > 0
    # A complete data set needs no work.
    assert generate(capsys, *arguments, "--dry-run")["made"] is False


def test_share_and_codes(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("lut", tmp_path / "out", "--sources", photographs / "coffee.tif", "--light", "all")
    options = ("--rendering", "codes", "--shard-images", 3, "--dry-run")
    forecast = generate(capsys, *arguments, *options, "--shard", "1/2")
    assert (forecast["images"], forecast["outside_gamut"]) == (1, None)
    assert generate(capsys, *arguments, *options)["images"] == 4


def test_refuses_pictures_that_cannot_be_read(photographs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main = import_module("generator.cli").main
    assert main(["lut", "out", "--sources", str(photographs / "broken.png"), "--dry-run"]) == 2
    assert "0 of 1 pictures can be used" in capsys.readouterr().err
