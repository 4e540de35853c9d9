"""Damage is found and traced to the light, and tables that do not correspond are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from calibration.table.lut import Lut, open_lut
from calibration.table.verification import find_faults, require_match
from foundation.errors import FormatError
from tests.calibration.table.tables import LIGHTS, flip, write


def lose_the_frames(folder: Path) -> None:
    (folder / "frames.csv").unlink()


def spoil_the_frames(folder: Path) -> None:
    (folder / "frames.csv").write_text("a\nb\n")


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (flip("samples.npy", -1), f"the samples of 1 of {len(LIGHTS)} lights have changed: {len(LIGHTS) - 1}"),
        (flip("samples.npy", 128 + 2 * 1200 + 7), f"1 of {len(LIGHTS)} lights have changed: 2"),
        (flip("samples.npy", 128 + 1199), f"1 of {len(LIGHTS)} lights have changed: 0"),
        (flip("illuminations.csv", -3), "ground truth have changed"),
        (flip("frames.csv", -3), "does not list the frames"),
        (lose_the_frames, "does not list the frames"),
        (spoil_the_frames, "frames.csv is damaged"),
    ],
)
def test_damage_is_found_and_named(tmp_path: Path, change: Callable[[Path], None], fault: str) -> None:
    lut = write(tmp_path / "lut")
    change(lut.folder)
    seen: list[tuple[int, int]] = []
    faults = find_faults(open_lut(lut.folder), lambda done, total: seen.append((done, total)))
    assert len(faults) == 1
    assert fault in faults[0]
    assert seen[-1] == (len(LIGHTS), len(LIGHTS))


def test_tables_of_one_chart_and_one_list_of_lights_match(tmp_path: Path) -> None:
    require_match(write(tmp_path / "one", 0), write(tmp_path / "other", 1))


def test_tables_that_do_not_correspond_are_refused(tmp_path: Path) -> None:
    one = write(tmp_path / "one")
    with pytest.raises(FormatError, match=r"chart cdcdcdcdcdcd… against efefefefefef…"):
        require_match(one, write(tmp_path / "chart", chart="ef" * 32))
    with pytest.raises(FormatError, match=f"{len(LIGHTS)} lights against 3"):
        require_match(one, write(tmp_path / "fewer", lights=3))
    with pytest.raises(FormatError, match="1 bits of each channel against 3"):
        require_match(one, _with(write(tmp_path / "bits"), tmp_path, bits=3))
    shutil.copytree(one.folder, tmp_path / "codes")
    path = tmp_path / "codes" / "illuminations.csv"
    path.write_text(path.read_text().replace("0,uniform,,0,255,0,", "0,uniform,,0,254,0,"))
    with pytest.raises(FormatError, match="other codes under 1 lights: 0"):
        require_match(one, open_lut(tmp_path / "codes"))


def _with(lut: Lut, folder: Path, bits: int) -> Lut:
    known = lut.provenance.model_copy(update={"bits": bits})
    return Lut(folder, lut.samples, lut.illuminations, lut.white, known)
