"""What a table says of its origin: from raw files, journal, settings and the lab, and how it is cited."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest

from calibration.citation import (
    NOT_RECORDED,
    OriginRecord,
    StatedOrigin,
    bibtex,
    origin_lines,
    origin_record,
    serial_hash,
    tex_text,
    with_published_serials,
)
from calibration.cli import main
from calibration.table.lut import open_lut, parse_provenance
from drivers.raw.rawfile import FrameOrigin
from experiment.config import CameraSettings, CitationSettings, parse_lab
from experiment.session.records import FrameRecord
from foundation.errors import ConfigurationError
from tests.calibration.table.tables import write

BODY = FrameOrigin("Canon EOS 550D", "1234567890", "EF50mm f/1.8 II", 100, 8.0, 0.5)
START = datetime(2026, 3, 1, 23, 30, tzinfo=timezone(timedelta(hours=2)))
RECORDS = [
    FrameRecord(
        "light", number, f"frames/{number}.cr2", "0" * 64, START + timedelta(seconds=60 * number), 0.5, "accepted"
    )
    for number in (1, 0, 2)
]
DEVICES = {"camera": "Canon Canon EOS 550D, serial number 77", "projector": "Acme 3000", "software": "croplab 0.1.0"}


def stated(citation: CitationSettings | None = None, rig: str | None = "lab") -> StatedOrigin:
    known = citation or CitationSettings()
    return StatedOrigin(known, rig, CameraSettings(iso=200), DEVICES)  # pyrefly: ignore[bad-argument-type]


def test_the_raw_files_come_before_settings_and_journal() -> None:
    other = replace(BODY, iso=400)
    found = origin_record(stated(CitationSettings(lens="by hand", camera_serial="plain")), RECORDS, [other, BODY, BODY])
    assert (found.camera_serial, found.lens, found.iso, found.exposure_by) == (
        "1234567890",
        BODY.lens,
        100,
        "raw files",
    )
    # 23:30 at UTC + 2 is 21:30; the frames were taken a minute apart and are listed out of order.
    assert (found.first_frame, found.last_frame) == ("2026-03-01T21:30:00+00:00", "2026-03-01T21:32:00+00:00")
    assert (found.projector, found.taken_by, found.frames) == ("Acme 3000", "croplab 0.1.0", 3)


def test_what_raw_files_do_not_state_comes_from_settings_journal_and_lab() -> None:
    found = origin_record(stated(CitationSettings(lens="Nikkor 50", camera_serial="plain")), RECORDS, [FrameOrigin()])
    assert (found.iso, found.aperture, found.exposure_by) == (200, 8.0, "settings")
    assert (found.lens, found.camera_serial) == ("Nikkor 50", "77")


def test_a_lens_without_an_aperture_has_none_in_the_origin() -> None:
    known = replace(stated(), camera=CameraSettings(iso=200, aperture="none"))
    found = origin_record(known, RECORDS, [FrameOrigin()])
    assert (found.iso, found.aperture, found.shutter_s) == (200, None, 0.5)


def test_settings_of_a_session_that_set_no_camera_are_no_exposure() -> None:
    known = StatedOrigin(CitationSettings(), "imported", None, {})
    found = origin_record(known, RECORDS, [FrameOrigin()])
    assert (found.iso, found.shutter_s, found.exposure_by, found.projector) == (None, None, None, None)
    assert dict(origin_lines(found))["Exposure"] == NOT_RECORDED


def test_the_lab_names_a_projector_without_a_control_port() -> None:
    known = stated(CitationSettings(projector="Barco on the left"))
    assert origin_record(known, RECORDS, [BODY]).projector == "Barco on the left"


@pytest.mark.parametrize("form", ["hash", "withheld"])
def test_a_serial_number_that_is_not_told_stands_nowhere(form: str) -> None:
    citation = CitationSettings.model_validate({"camera_serial": form})
    found = origin_record(stated(citation), RECORDS, [BODY])
    text = found.model_dump_json() + json.dumps(origin_lines(found))
    told = with_published_serials([BODY, replace(BODY, serial="99")], citation.camera_serial)
    assert BODY.serial not in text + repr(told)
    assert found.camera_serial_is == form
    assert ("(hash)" in text) is (form == "hash")
    # Frames of another body must still be told apart.
    assert told[0].serial != told[1].serial


@pytest.mark.slow
def test_the_hash_is_the_bodys_alone() -> None:
    assert serial_hash("A", "1") == serial_hash("A", "1")
    assert len({serial_hash("A", "1"), serial_hash("A", "2"), serial_hash("B", "1")}) == 3
    assert re.fullmatch("[0-9a-f]{32}", serial_hash("A", "1"))


def test_lab_toml_states_the_citation() -> None:
    head = 'rig = "simulated"\nchart = "c"\nilluminations = "i"\n[citation]\n'
    found = parse_lab(head + 'authors = ["Family, Given", "Institute"]\nlicence = "mit"\n', "LAB.toml")
    assert found.citation.licence == "MIT"
    assert parse_lab(found.to_toml(), "session.toml").citation == found.citation
    with pytest.raises(ConfigurationError, match=r"citation\.licence"):
        parse_lab(head + 'licence = "public domain"\n', "LAB.toml")
    with pytest.raises(ConfigurationError):
        parse_lab(head + 'license = "MIT"\n', "LAB.toml")


def test_an_entry_has_what_is_known_and_names_what_is_not() -> None:
    origin = OriginRecord(authors=["Knuth, Donald", "A & B Institute"], last_frame="2026-03-01T00:00:00+00:00")
    entry = bibtex("Canon EOS 550D", 707, "croplab 0.1.0", "ab" * 32, origin)
    assert "author = {Knuth, Donald and {A \\& B Institute}}" in entry
    assert "@misc{knuth-canoneos550d-2026-abababab," in entry
    assert "year = {2026}" in entry
    assert entry.startswith("% not recorded by the table: url, licence\n")
    older = bibtex("Canon EOS 550D", 707, "croplab 0.1.0", "ab" * 32, None)
    assert "author =" not in older
    assert "% not recorded by the table: author, year, url, licence" in older


def test_text_that_tex_would_run_is_printed() -> None:
    hostile = tex_text(r"50 % \input{x} $a_1$ #~^")
    unescaped = re.sub(r"\\[{}&%$#_]|\\text\w+\{\}", "", hostile)
    assert not re.search(r"[\\{}&%$#_~^]", unescaped)


def test_a_simulated_table_is_not_called_photographed() -> None:
    assert "simulated" in bibtex("C", 1, "s", "0" * 64, OriginRecord(rig="simulated"))
    assert "computed" in bibtex("C", 1, "s", "0" * 64, None, computed=True)


def test_a_table_without_an_origin_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "lut")
    assert "origin" not in json.loads((tmp_path / "lut" / "lut.json").read_text())
    assert main(["info", str(tmp_path / "lut")]) == 0
    printed = dict(re.findall(r"^([^:\n]+): +(.*)$", capsys.readouterr().out, re.MULTILINE))
    for name, _ in origin_lines(None):
        assert printed[name] == NOT_RECORDED
    assert main(["info", str(tmp_path / "lut"), "--cite"]) == 0
    printed_entry = capsys.readouterr().out
    assert open_lut(tmp_path / "lut").sha256 in printed_entry


def test_an_origin_is_carried_by_the_file_unchanged() -> None:
    origin = origin_record(stated(CitationSettings(note="dust on the lens", licence="CC-BY-4.0")), RECORDS, [BODY])
    text = json.dumps(
        {
            "format": "crop.lut", "version": 1, "camera": "C", "bits": 1, "white_level": 9, "session_sha256": "",
            "chart_sha256": "", "software": "", "has_sums": True, "origin": origin.model_dump(mode="json"),
        }
    )  # fmt: skip
    known = parse_provenance(text.encode(), Path("lut.json"))
    assert known.origin == origin
    assert parse_provenance(known.to_json().encode(), Path("lut.json")).origin == origin


def test_an_address_ends_no_entry() -> None:
    origin = OriginRecord(url="https://doi.example/10.1/{a}\\b\n c")
    assert "url = {https://doi.example/10.1/abc}," in bibtex("Test", 3, "croplab", "0" * 64, origin)


def test_bodies_without_their_numbers_are_counted_as_they_come() -> None:
    origins = [FrameOrigin("Test", serial) for serial in ("7", "8", "7")]
    told = [one.serial for one in with_published_serials(origins, "withheld")]
    assert told == ["withheld (1)", "withheld (2)", "withheld (1)"]
