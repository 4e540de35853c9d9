"""Detection of damage, down to the illuminant, and refusal of LUTs that do not correspond."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from calibration.table.lut import Lut, open_lut
from calibration.table.verification import find_faults, require_match
from foundation.errors import FormatError
from foundation.files import sha256_of
from tests.calibration.table.tables import LIGHTS, flip, write


def delete(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def add_references(folder: Path) -> None:
    (folder / "references.csv").write_text("light,name\n")


def clear_has_sums(folder: Path) -> None:
    path = folder / "lut.json"
    path.write_text(path.read_text().replace('"has_sums": true', '"has_sums": false'))


def raise_saturation(folder: Path) -> None:
    path = folder / "lut.json"
    path.write_text(path.read_text().replace('"white_level": 11000', '"white_level": 12000'))


def append_bytes(folder: Path) -> None:
    with (folder / "samples.npy").open("ab") as stream:
        stream.write(b"12")


# changes of small files, which are detected by `find_faults` and by `open_lut`
SMALL = [
    (flip("illuminations.csv", -3), "ground truth"),
    (flip("frames.csv", -3), "frames.csv has changed"),
    (delete("frames.csv"), "frames.csv is missing"),
    (raise_saturation, "lut.json has changed"),
    (add_references, "references.csv was added"),
]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (flip("samples.npy", -1), f"1 of {len(LIGHTS)} illuminants have changed: {len(LIGHTS) - 1}"),
        (flip("samples.npy", 128 + 2 * 1200 + 7), f"1 of {len(LIGHTS)} illuminants have changed: 2"),
        *SMALL,
    ],
)
def test_reports_damage(tmp_path: Path, change: Callable[[Path], None], fault: str) -> None:
    lut = write(tmp_path / "lut")
    change(lut.folder)
    steps: list[tuple[int, int]] = []
    faults = find_faults(open_lut(lut.folder, check=False), lambda count, total: steps.append((count, total)))
    assert len(faults) == 1
    assert fault in faults[0]
    assert steps[-1] == (len(LIGHTS), len(LIGHTS))


def test_accepts_luts_of_same_chart_and_illuminants(tmp_path: Path) -> None:
    require_match(write(tmp_path / "one", 0), write(tmp_path / "other", 1))


def test_refuses_luts_that_do_not_correspond(tmp_path: Path) -> None:
    lut = write(tmp_path / "one")
    with pytest.raises(FormatError):
        require_match(lut, write(tmp_path / "chart", chart="ef" * 32))
    with pytest.raises(FormatError):
        require_match(lut, write(tmp_path / "fewer", lights=3))
    with pytest.raises(FormatError):
        require_match(lut, with_bits(write(tmp_path / "bits"), tmp_path, bits=3))
    shutil.copytree(lut.folder, tmp_path / "codes")
    path = tmp_path / "codes" / "illuminations.csv"
    path.write_text(path.read_text().replace("0,uniform,,0,255,0,", "0,uniform,,0,254,0,"))
    with pytest.raises(FormatError):
        require_match(lut, open_lut(tmp_path / "codes", check=False))


def test_report_is_verified_but_optional(tmp_path: Path) -> None:
    (tmp_path / "lut").mkdir()
    lut = write(tmp_path / "lut", report="<html>accept</html>")
    assert "report.html" in (lut.folder / "SHA256SUMS").read_text()
    flip("report.html", 7)(lut.folder)
    with pytest.raises(FormatError, match=r"report\.html.*build"):
        open_lut(lut.folder)
    delete("report.html")(lut.folder)
    assert open_lut(lut.folder).sha256 == lut.sha256
    assert find_faults(lut) == []


def test_sha256sum_verifies_lut(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    check = subprocess.run(
        ["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=lut.folder, capture_output=True, text=True, check=True
    )
    assert set(check.stdout.split()) >= {"samples.npy:", "illuminations.csv:", "lut.json:", "frames.csv:"}
    own_hash = subprocess.run(["sha256sum", "SHA256SUMS"], cwd=lut.folder, capture_output=True, text=True, check=True)
    assert own_hash.stdout.split()[0] == lut.sha256


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("unfit", [{"colour": 8, "cause": "x"}], "colour 8, "),
        ("lights_sha256", ["00" * 32], "1 illuminants, expected 5"),
        ("lights_sha256", ["x"] * 5, "lights_sha256.0"),
        ("files_sha256", {"../frames.csv": "00" * 32}, "files_sha256"),
        ("camera", {"a": 1}, "camera"),
    ],
)
def test_refuses_inconsistent_provenance(tmp_path: Path, key: str, value: object, fault: str) -> None:
    lut = write(tmp_path / "lut")
    path, sums = lut.folder / "lut.json", lut.folder / "SHA256SUMS"
    old_hash = sha256_of(path.read_bytes())
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    sums.write_text(sums.read_text().replace(old_hash, sha256_of(path.read_bytes())))
    with pytest.raises(FormatError, match=fault):
        open_lut(lut.folder)


def test_refuses_samples_of_wrong_size_without_check(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    path = lut.folder / "lut.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"bits": 2}))
    with pytest.raises(FormatError, match=r"expected uint16 \(5, 64, samples, 3\)"):
        open_lut(lut.folder, check=False)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        *SMALL,
        (flip("SHA256SUMS", 3), "has changed since the build"),
        (delete("SHA256SUMS"), "SHA256SUMS"),
        (delete("samples.npy"), "samples.npy"),
        (delete("illuminations.csv"), "illuminations"),
        (clear_has_sums, "SHA256SUMS"),
        (append_bytes, "6130 bytes, expected 6128"),
    ],
)
def test_refuses_changed_small_files(tmp_path: Path, change: Callable[[Path], None], fault: str) -> None:
    lut = write(tmp_path / "lut")
    change(lut.folder)
    with pytest.raises(FormatError, match=fault):
        open_lut(lut.folder)


@pytest.mark.parametrize("name", ["samples.npy", "illuminations.csv", "lut.json", "frames.csv", "SHA256SUMS", "more"])
@pytest.mark.parametrize("kind", ["pipe", "link out", "device", "lost link"])
def test_refuses_irregular_files(tmp_path: Path, name: str, kind: str) -> None:
    lut = write(tmp_path / "lut")
    path = lut.folder / name
    path.unlink(missing_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "link out":
            (tmp_path / "outside").write_text("secret")
            path.symlink_to(tmp_path / "outside")
        case "device":
            path.symlink_to("/dev/zero")
        case _:
            path.symlink_to("nowhere")
    with pytest.raises(FormatError, match=f"{name} is a "):
        open_lut(lut.folder)


def test_refuses_file_of_excessive_size(tmp_path: Path) -> None:
    lut = write(tmp_path / "lut")
    with (lut.folder / "lut.json").open("r+b") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(FormatError):
        open_lut(lut.folder)


def with_bits(lut: Lut, folder: Path, bits: int) -> Lut:
    provenance = lut.provenance.model_copy(update={"bits": bits})
    return Lut(folder, lut.samples, lut.illuminations, lut.white, provenance)
