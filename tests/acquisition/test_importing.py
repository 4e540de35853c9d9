"""Sessions from raw files taken by other means: what their list may say."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from acquisition.illuminations import Illumination, save_illuminations
from acquisition.importing import import_session
from acquisition.layout import design_chart
from acquisition.session import FRAME_COLUMNS, Session
from drivers.errors import FormatError
from drivers.presenter import Colour

LIGHTS = tuple(Illumination(number, "uniform", None, Colour(255, number, 0)) for number in range(3))
Row = Mapping[str, object]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a chart, lights, and a raw file for each; their content does not matter, it is judged."""
    design_chart(bits=1).save(tmp_path / "chart.json")
    save_illuminations(LIGHTS, tmp_path / "illuminations.csv")
    for light in LIGHTS:
        (tmp_path / f"{light.index}.cr2").write_bytes(b"raw of light %d" % light.index)
    return tmp_path


def light(number: int, **cells: object) -> Row:
    return {"kind": "light", "illumination": number, "file": f"{number}.cr2", "verdict": "accepted", **cells}


def import_rows(folder: Path, rows: Sequence[Row]) -> list[str]:
    with (folder / "list.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(FRAME_COLUMNS)
        writer.writerows([row.get(column, "") for column in FRAME_COLUMNS] for row in rows)
    return import_session(folder / "list.csv", folder / "chart.json", folder / "session")


def test_listed_frames_make_a_session(folder: Path) -> None:
    rows = [light(0), light(1, verdict="refused: a hand"), light(2), light(2), {"kind": "white", "file": "0.cr2"}]
    assert import_rows(folder, [*rows[:-1], {**rows[-1], "verdict": "accepted"}]) == ["1.cr2: a hand"]
    with Session.open(folder / "session") as session:
        assert [frame.accepted for frame in session.frames()] == [True, False, True, True, True]
        assert [frame.verdict for frame in session.frames()][1] == "refused: a hand"


def test_two_lights_of_one_file_leave_nothing(folder: Path) -> None:
    (folder / "2.cr2").write_bytes((folder / "0.cr2").read_bytes())
    with pytest.raises(FormatError, match=r"list\.csv: lights 0 and 2 have the same raw file, 0\.cr2 and 2\.cr2; list"):
        import_rows(folder, [light(0), light(1), light(2)])
    assert not (folder / "session").exists()
