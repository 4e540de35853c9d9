"""Raw files: real ones against dcraw's own output, made ones with odd margins, damaged ones."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from drivers.rawfile import read_raw


def test_counts_are_dcraws(raw_folder: Path) -> None:
    # Measured with dcraw 9.28, -D -4 -T.
    for line in (raw_folder / "dcraw_D4T.sha256").read_text().splitlines():
        digest, name, shape = line.split()
        mosaic = read_raw(raw_folder / name)
        assert f"{mosaic.counts.shape[0]}x{mosaic.counts.shape[1]}" == shape
        assert hashlib.sha256(mosaic.counts.astype("<u2").tobytes()).hexdigest() == digest


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("canon_eos_550d_colorchart.dng", "Canon EOS Kiss X4"),
        ("canon_powershot_g2.crw", "Canon PowerShot G2"),
        ("blackmagic.dng", "Blackmagic Pocket Cinema Camera 4K"),
    ],
)
def test_names_the_camera(raw_folder: Path, name: str, camera: str) -> None:
    mosaic = read_raw(raw_folder / name)
    assert mosaic.camera == camera
    assert mosaic.pattern == "RGGB"
