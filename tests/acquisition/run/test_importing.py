"""Import of raw files taken by other means, and contents of their list."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from acquisition.cli import main
from acquisition.run.importing import Imported, import_session
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.lights import Illuminant, save_illuminants
from experiment.session.folder import FRAME_COLUMNS, Session
from foundation.errors import FormatError
from tests.drivers.raw.maker_files import raf
from tests.drivers.raw.raw_files import write_dng
from tests.json_of import json_of

LIGHTS = tuple(Illuminant(number, "uniform", None, Colour(255, number, 0)) for number in range(3))
Row = Mapping[str, object]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a chart, lights, and a raw file for each."""
    design_chart(bits=1).save(tmp_path / "chart.json")
    save_illuminants(LIGHTS, tmp_path / "illuminations.csv")
    for light in LIGHTS:
        counts = np.random.default_rng(light.index).integers(100, 3000, (32, 32)).astype(np.uint16)
        write_dng(tmp_path / f"{light.index}.cr2", counts)
    return tmp_path


def light(number: int, **cells: object) -> Row:
    return {"kind": "light", "illumination": number, "file": f"{number}.cr2", "verdict": "accepted", **cells}


def import_rows(folder: Path, rows: Sequence[Row]) -> Imported:
    write(folder, rows)
    return import_session(folder / "list.csv", folder / "chart.json", folder / "session")


def write(folder: Path, rows: Sequence[Row]) -> None:
    with (folder / "list.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(FRAME_COLUMNS)
        writer.writerows([row.get(column, "") for column in FRAME_COLUMNS] for row in rows)


def test_lists_uncheckable_formats_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in (1, 2):
        (folder / f"{number}.RAF").write_bytes(raf(seed=number)[0])
    rows = [light(0), *(light(number, file=f"{number}.RAF") for number in (1, 2))]
    write(folder, [*rows, *({"kind": kind, "file": "0.cr2", "verdict": "accepted"} for kind in ("white", "dark"))])
    assert main(["import", *(str(folder / name) for name in ("list.csv", "chart.json", "session"))]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "checked" in line]
    assert line.startswith(".raf: ")
    assert "complete" in line
    with Session.open(folder / "session") as session:
        assert all(frame.accepted for frame in session.frames())


def test_imports_listed_frames(folder: Path) -> None:
    rows = [light(0), light(1, verdict="refused: a hand"), light(2), light(2), {"kind": "white", "file": "0.cr2"}]
    imported = import_rows(folder, [*rows[:-1], {**rows[-1], "verdict": "accepted"}])
    assert imported == Imported(("1.cr2: a hand",), ("illuminant 1",), ())
    with Session.open(folder / "session") as session:
        assert [frame.accepted for frame in session.frames()] == [True, False, True, True, True]
        assert [frame.verdict for frame in session.frames()][1] == "refused: a hand"


def test_records_source_of_verdict(folder: Path) -> None:
    import_rows(folder, [light(0), light(1, verdict="")])
    with Session.open(folder / "session") as session:
        assert [one.checks[0].name for one in session.journal.details().values()] == ["list", "exposure"]


def test_refuses_damaged_file_despite_list(folder: Path) -> None:
    write_dng(folder / "1.cr2", np.where(np.arange(1024).reshape(32, 32) > 800, 0, 900).astype(np.uint16))
    (folder / "2.cr2").write_bytes(b"II*\0")
    filled, cut = import_rows(folder, [light(0), light(1), light(2)]).refused
    assert "1.cr2: " in filled
    assert "half of its black level" in filled
    assert "2.cr2: " in cut


def test_refuses_one_file_for_two_illuminants(folder: Path) -> None:
    (folder / "2.cr2").write_bytes((folder / "0.cr2").read_bytes())
    with pytest.raises(FormatError, match=r"0\.cr2 and 2\.cr2") as caught:
        import_rows(folder, [light(0), light(1), light(2)])
    assert (caught.value.about, caught.value.value) == (folder / "list.csv", (0, 2))
    assert not (folder / "session").exists()


@pytest.mark.parametrize("exposure_s", ["nan", "inf", "-5"])
def test_refuses_invalid_exposure_time(folder: Path, exposure_s: str) -> None:
    with pytest.raises(FormatError, match="exposure_s") as caught:
        import_rows(folder, [light(0), light(1, exposure_s=exposure_s)])
    assert str(caught.value.about).endswith("list.csv, line 3")
    assert str(caught.value.value) == str(float(exposure_s))
    assert not (folder / "session").exists()


@pytest.mark.parametrize("verdict", ["ok", "Accepted", "rubbish", "refused:dark"])
def test_refuses_invalid_verdict(folder: Path, verdict: str) -> None:
    with pytest.raises(FormatError, match="line 2: verdict") as caught:
        import_rows(folder, [light(0, verdict=verdict)])
    assert caught.value.value == verdict


def test_accepts_refusal_without_reason(folder: Path) -> None:
    assert import_rows(folder, [light(0, verdict="refused")]).refused == ("0.cr2: the list gives no reason",)


def test_reports_missing_list(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"nowhere\.csv: No such file"):
        import_session(tmp_path / "nowhere.csv", tmp_path / "chart.json", tmp_path / "session")


@pytest.mark.slow
@pytest.mark.parametrize(("verdict", "code"), [("refused: a hand", 4), ("accepted", 0)])
def test_exit_code_reports_missing_illuminant(
    folder: Path, verdict: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another frame of the illuminant may be refused."""
    write(folder, [light(0), light(1, verdict="refused: a hand"), light(1, verdict=verdict)])
    arguments = ("import", folder / "list.csv", folder / "chart.json", folder / "session")
    found = json_of(main, arguments, capsys, code)
    assert len(found["refused"]) == (3 if code else 2) - 1
    assert found["left"] == (["illuminant 1"] if code else [])
    shutil.rmtree(folder / "session")
    assert main(list(map(str, arguments))) == code
    assert ("accepted frames: illuminant 1;" in capsys.readouterr().err) == (code == 4)


def test_clock_that_goes_back_keeps_the_order(folder: Path) -> None:
    # In Zagreb, 2026-10-25 02:00 to 03:00 occurred twice.
    times = ("2026-10-25T02:50:00+02:00", "2026-10-25T02:10:00+01:00", "2026-10-25T01:30:00Z")
    import_rows(folder, [light(number, taken_at=time) for number, time in enumerate(times)])
    with Session.open(folder / "session") as session:
        taken = [frame.taken_at.isoformat() for frame in session.frames()]
    assert taken == ["2026-10-25T00:50:00+00:00", "2026-10-25T01:10:00+00:00", "2026-10-25T01:30:00+00:00"]


@pytest.mark.parametrize(
    "time",
    [
        "2026-10-25T02:50:00",
        "2026-10-25 02:50",
        "2026-10-25",
        "0000:00:00 00:00:00",
        "0001-01-01T00:00:00+14:00",
        "9999-12-31T23:59:59-12:00",
        "1969-12-31T23:59:59Z",
    ],
)
def test_refuses_times_that_cannot_be_ordered(folder: Path, time: str) -> None:
    with pytest.raises(FormatError, match=r"line 2.* offset"):
        import_rows(folder, [light(0, taken_at=time)])
    assert not (folder / "session").exists()


def test_offset_with_seconds_can_be_read_again(folder: Path) -> None:
    # Local mean time; a journal has no place for seconds of an offset.
    import_rows(folder, [light(0, taken_at="2026-10-25T02:50:00+01:03:50")])
    with Session.open(folder / "session") as session:
        assert [frame.taken_at.isoformat() for frame in session.frames()] == ["2026-10-25T01:46:10+00:00"]


def test_refuses_a_list_with_some_times(folder: Path) -> None:
    with pytest.raises(FormatError, match=r"1 of 2 frames have no taken_at, the first in line 3"):
        import_rows(folder, [light(0, taken_at="2026-10-25T02:50:00+02:00"), light(1)])
