"""The table on disk: read for ever, its damage told to the light, two of them compared."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from acquisition.lights.illuminations import plan_illuminations
from calibration.table.lut import Frame, Lut, LutWriter, Provenance, damage, frames_sha256, open_lut, require_match
from foundation.errors import FormatError, InputError, StorageError

VERSION_1 = Path(__file__).parent / "table_v1"
"""Written by the first release of the format; never to be written again."""

LIGHTS = plan_illuminations(1, (2500, 6500))
FRAMES = [Frame("white", None, "frames/0000_white.dng", "00" * 32)] + [
    Frame("light", light.index, f"frames/{light.index + 2:04d}_light.dng", f"{light.index:02x}" * 32)
    for light in LIGHTS
]


def write(folder: Path, seed: int = 0, chart: str = "cd" * 32, lights: int = len(LIGHTS)) -> Lut:
    folder.mkdir()
    writer = LutWriter(folder, lights, 8, 25)
    values = np.random.default_rng(seed).integers(0, 14000, (lights, 8, 25, 3), dtype=np.uint16)
    for light in reversed(range(lights)):
        writer.put(light, values[light])
    writer.finish(
        LIGHTS[:lights],
        np.full((lights, 3), 9000.0),
        Provenance(
            camera="Test",
            bits=1,
            white_level=11000,
            session_sha256=frames_sha256(FRAMES),
            chart_sha256=chart,
            software="croplab test",
        ),
        FRAMES,
    )
    lut = open_lut(folder)
    assert np.array_equal(lut.samples, values)
    return lut


def test_a_table_of_version_1_is_read_for_ever() -> None:
    lut = open_lut(VERSION_1)
    values = np.arange(2 * 8 * 3 * 3) * 331 % 14000
    assert np.array_equal(lut.samples.ravel(), values)
    assert lut.white.tolist() == [[9000.5, 12000.25, 7000.125], [1, 2, 8000]]
    assert [light.colour.green for light in lut.illuminations] == [255, 0]
    assert lut.provenance.camera == "Canon EOS 550D"
    assert [cell.colour for cell in lut.provenance.unfit] == [5]
    assert lut.frames == ()
    with pytest.raises(InputError, match="records no hashes"):
        damage(lut)


def test_the_name_of_a_table_of_version_1_stays() -> None:
    """Datasets made from such a table hold it."""
    content = (VERSION_1 / "lut.json").read_bytes() + (VERSION_1 / "illuminations.csv").read_bytes()
    assert open_lut(VERSION_1).sha256 == hashlib.sha256(content).hexdigest()


def test_the_hashes_are_those_of_the_files(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    told = json.loads((lut.folder / "lut.json").read_text())
    assert told["samples_sha256"] == hashlib.sha256((lut.folder / "samples.npy").read_bytes()).hexdigest()
    assert told["illuminations_sha256"] == hashlib.sha256((lut.folder / "illuminations.csv").read_bytes()).hexdigest()
    assert told["lights_sha256"] == [hashlib.sha256(slab.tobytes()).hexdigest() for slab in lut.samples]
    assert list(lut.frames) == FRAMES
    assert damage(lut) == []


def test_a_table_s_name_changes_with_its_samples(tmp_path: Path) -> None:
    assert write(tmp_path / "one", 0).sha256 == write(tmp_path / "same", 0).sha256
    assert write(tmp_path / "other", 1).sha256 != open_lut(tmp_path / "one").sha256


def flip(name: str, place: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[place] ^= 1
        (folder / name).write_bytes(data)

    return change


def lose_the_frames(folder: Path) -> None:
    (folder / "frames.csv").unlink()


def spoil_the_frames(folder: Path) -> None:
    (folder / "frames.csv").write_text("a\nb\n")


@pytest.mark.parametrize(
    ("change", "told"),
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
def test_damage_is_found_and_told_where(tmp_path: Path, change: Callable[[Path], None], told: str) -> None:
    lut = write(tmp_path / "lut")
    change(lut.folder)
    seen: list[tuple[int, int]] = []
    faults = damage(open_lut(lut.folder), lambda done, total: seen.append((done, total)))
    assert len(faults) == 1
    assert told in faults[0]
    assert seen[-1] == (len(LIGHTS), len(LIGHTS))


def test_samples_that_have_changed_are_not_used(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    flip("samples.npy", 128 + 2 * 1200 + 7)(lut.folder)
    changed = open_lut(lut.folder)
    for light in (0, 1, 3):
        changed.require_unchanged(light)
    with pytest.raises(FormatError, match=r"samples\.npy: the samples of light 2 are not those .*build-lut --verify"):
        changed.require_unchanged(2)


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


def test_tables_of_one_chart_and_one_list_of_lights_match(tmp_path: Path) -> None:
    require_match(write(tmp_path / "one", 0), write(tmp_path / "other", 1))


def test_tables_that_do_not_correspond_are_told_apart(tmp_path: Path) -> None:
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


def test_a_table_in_the_making_is_not_read(tmp_path: Path) -> None:
    (tmp_path / ".lut.partial").mkdir()
    LutWriter(tmp_path / ".lut.partial", 1, 8, 25)
    with pytest.raises(FormatError, match="is a table in the making; finish it with build-lut"):
        open_lut(tmp_path / "lut")
