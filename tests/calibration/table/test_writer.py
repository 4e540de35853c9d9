"""What is written has the hashes that it records, and a disk that loses it is noticed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from calibration.table.lut import Provenance
from calibration.table.verification import find_faults
from calibration.table.writer import LutWriter
from foundation.errors import StorageError
from tests.calibration.table.tables import FRAMES, LIGHTS, flip, write


def test_the_hashes_are_those_of_the_files(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    record = json.loads((lut.folder / "lut.json").read_text())
    assert record["samples_sha256"] == hashlib.sha256((lut.folder / "samples.npy").read_bytes()).hexdigest()
    assert record["illuminations_sha256"] == hashlib.sha256((lut.folder / "illuminations.csv").read_bytes()).hexdigest()
    assert record["lights_sha256"] == [hashlib.sha256(slab.tobytes()).hexdigest() for slab in lut.samples]
    assert list(lut.frames) == FRAMES
    assert find_faults(lut) == []


def test_a_disk_that_forgets_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "lut").mkdir()
    writer = LutWriter(tmp_path / "lut", 1, 8, 25)
    writer.put(0, np.ones((8, 25, 3), dtype=np.uint16))
    flip("samples.npy", -1)(tmp_path / "lut")
    assert writer.damaged() == [0]
    known = Provenance(camera="T", bits=1, white_level=1, session_sha256="", chart_sha256="", software="")
    with pytest.raises(StorageError, match="lights 0 read back are not those written"):
        writer.finish(LIGHTS[:1], np.ones((1, 3)), known)
    assert not (tmp_path / "lut" / "lut.json").exists()
