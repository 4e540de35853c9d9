"""The LUT on disk, and refusal of changed samples."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from calibration.table.lut import MOST_WHITE, Provenance, map_samples, open_lut
from calibration.table.verification import find_faults
from calibration.table.writing import LutWriter
from foundation.errors import FormatError, StorageError
from tests.calibration.table.tables import FRAMES, LIGHTS, flip, write


def test_records_hashes_of_files(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    record = json.loads((lut.folder / "lut.json").read_text())
    assert record["samples_sha256"] == hashlib.sha256((lut.folder / "samples.npy").read_bytes()).hexdigest()
    assert record["illuminations_sha256"] == hashlib.sha256((lut.folder / "illuminations.csv").read_bytes()).hexdigest()
    assert record["lights_sha256"] == [hashlib.sha256(slab.tobytes()).hexdigest() for slab in lut.samples]
    assert list(lut.frames) == FRAMES
    assert find_faults(lut) == []


@pytest.mark.parametrize("invalid", [0, -1, MOST_WHITE, "nan"])
def test_refuses_invalid_ground_truth(invalid: object, tmp_path: Path) -> None:
    path = write(tmp_path / "lut").folder / "illuminations.csv"
    header, first, *other_rows = path.read_text().splitlines()
    row = first.split(",")
    row[header.split(",").index("white_g")] = str(invalid)
    path.write_text("\n".join([header, ",".join(row), *other_rows, ""]))
    with pytest.raises(FormatError):
        open_lut(path.parent)


def test_detects_samples_lost_by_disk(tmp_path: Path) -> None:
    (tmp_path / "lut").mkdir()
    writer = LutWriter(tmp_path / "lut", 1, 8, 25)
    writer.put(0, np.ones((8, 25, 3), dtype=np.uint16))
    flip("samples.npy", -1)(tmp_path / "lut")
    assert writer.damaged() == [0]
    provenance = Provenance(camera="T", bits=1, white_level=1, session_sha256="", chart_sha256="", software="")
    with pytest.raises(StorageError, match="illuminants 0 "):
        writer.finish(LIGHTS[:1], np.ones((1, 3)), provenance)
    assert not (tmp_path / "lut" / "lut.json").exists()


def test_hash_depends_on_samples(tmp_path: Path) -> None:
    assert write(tmp_path / "one", 0).sha256 == write(tmp_path / "same", 0).sha256
    assert write(tmp_path / "other", 1).sha256 != open_lut(tmp_path / "one").sha256


def test_refuses_changed_samples(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    flip("samples.npy", 128 + 2 * 1200 + 7)(lut.folder)
    changed = open_lut(lut.folder)
    for light in (0, 1, 3):
        assert changed.light_samples(light).shape == (8, 25, 3)
    with pytest.raises(FormatError, match="illuminant 2 "):
        changed.light_samples(2)


@pytest.mark.parametrize(
    ("shape", "dtype", "order"),
    [
        ((2, 8, 1025, 3), "<u2", "C"),
        ((2, 8, 0, 3), "<u2", "C"),
        ((3, 8, 9, 3), "<u2", "C"),
        ((2, 8, 9, 4), "<u2", "C"),
        ((2, 8, 9, 3), ">u2", "C"),
        ((2, 8, 9, 3), "<u2", "F"),
    ],
)
def test_refuses_samples_of_wrong_format(
    shape: tuple[int, ...], dtype: str, order: Literal["C", "F"], tmp_path: Path
) -> None:
    np.save(tmp_path / "samples.npy", np.zeros(shape, dtype, order=order))
    with pytest.raises(FormatError, match=r"uint16 \(2, 8, samples, 3\) of 1 to 1024"):
        map_samples(tmp_path / "samples.npy", 2, 1)
    largest = np.arange(2 * 8 * 1024 * 3, dtype="<u2").reshape(2, 8, 1024, 3)
    np.save(tmp_path / "most.npy", largest)
    assert np.array_equal(map_samples(tmp_path / "most.npy", 2, 1), largest)


def test_refuses_unfinished_lut(tmp_path: Path) -> None:
    (tmp_path / ".lut.partial").mkdir()
    LutWriter(tmp_path / ".lut.partial", 1, 8, 25)
    with pytest.raises(FormatError):
        open_lut(tmp_path / "lut")
