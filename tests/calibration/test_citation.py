"""Origin of a table from raw files, journal, settings and lab, and its citation."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
import tomli_w

from calibration.citation import (
    NOT_RECORDED,
    OriginRecord,
    SessionOrigin,
    bibtex,
    origin_lines,
    origin_record,
    serial_hash,
    tex_text,
    with_published_serials,
)
from calibration.cli import main
from calibration.pipeline.frames import stated_origin
from calibration.table.lut import open_lut, parse_provenance
from drivers.raw.rawfile import FrameOrigin
from experiment.config import CameraSettings, CitationSettings, parse_lab
from experiment.session.folder import Session
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


def stated(citation: CitationSettings | None = None, rig: str | None = "lab") -> SessionOrigin:
    known = citation or CitationSettings()
    return SessionOrigin(known, rig, CameraSettings(iso=200), DEVICES)  # pyrefly: ignore[bad-argument-type]


def test_raw_files_precede_settings_and_journal() -> None:
    other = replace(BODY, iso=400)
    result = origin_record(
        stated(CitationSettings(lens="by hand", camera_serial="plain")), RECORDS, [other, BODY, BODY]
    )
    assert (result.camera_serial, result.lens, result.iso, result.exposure_by) == (
        "1234567890",
        BODY.lens,
        100,
        "raw files",
    )
    # 23:30 at UTC + 2 is 21:30; the frames were taken a minute apart and are listed out of order.
    assert (result.first_frame, result.last_frame) == ("2026-03-01T21:30:00+00:00", "2026-03-01T21:32:00+00:00")
    assert (result.projector, result.taken_by, result.frames) == ("Acme 3000", "croplab 0.1.0", 3)


def test_missing_raw_values_come_from_other_sources() -> None:
    result = origin_record(stated(CitationSettings(lens="Nikkor 50", camera_serial="plain")), RECORDS, [FrameOrigin()])
    assert (result.iso, result.aperture, result.exposure_by) == (200, 8.0, "settings")
    assert (result.lens, result.camera_serial) == ("Nikkor 50", "77")


def test_lens_without_aperture_records_none() -> None:
    known = replace(stated(), camera=CameraSettings(iso=200, aperture="none"))
    result = origin_record(known, RECORDS, [FrameOrigin()])
    assert (result.iso, result.aperture, result.shutter_s) == (200, None, 0.5)


def test_settings_without_camera_give_no_exposure() -> None:
    known = SessionOrigin(CitationSettings(), "imported", None, {})
    result = origin_record(known, RECORDS, [FrameOrigin()])
    assert (result.iso, result.shutter_s, result.exposure_by, result.projector) == (None, None, None, None)
    assert dict(origin_lines(result))["Exposure"] == NOT_RECORDED


def test_lab_names_projector_without_control_port() -> None:
    known = stated(CitationSettings(projector="Barco on the left"))
    assert origin_record(known, RECORDS, [BODY]).projector == "Barco on the left"


@pytest.mark.parametrize("form", ["hash", "withheld"])
def test_withheld_serial_appears_nowhere(form: str) -> None:
    citation = CitationSettings.model_validate({"camera_serial": form})
    result = origin_record(stated(citation), RECORDS, [BODY])
    text = result.model_dump_json() + json.dumps(origin_lines(result))
    published = with_published_serials([BODY, replace(BODY, serial="99")], citation.camera_serial)
    assert BODY.serial not in text + repr(published)
    assert result.camera_serial_is == form
    assert ("(hash)" in text) is (form == "hash")
    # Frames of another body must still be told apart.
    assert published[0].serial != published[1].serial


@pytest.mark.slow
def test_hash_identifies_body() -> None:
    assert serial_hash("A", "1") == serial_hash("A", "1")
    assert len({serial_hash("A", "1"), serial_hash("A", "2"), serial_hash("B", "1")}) == 3
    assert re.fullmatch("[0-9a-f]{32}", serial_hash("A", "1"))


def test_lab_toml_contains_citation() -> None:
    head = 'rig = "simulated"\nchart = "c"\nilluminations = "i"\n[citation]\n'
    result = parse_lab(head + 'authors = ["Family, Given", "Institute"]\nlicence = "mit"\n', "LAB.toml")
    assert result.citation.licence == "MIT"
    assert parse_lab(result.to_toml(), "session.toml").citation == result.citation
    with pytest.raises(ConfigurationError, match=r"citation\.licence"):
        parse_lab(head + 'licence = "public domain"\n', "LAB.toml")
    with pytest.raises(ConfigurationError):
        parse_lab(head + 'license = "MIT"\n', "LAB.toml")


def test_entry_lists_missing_fields() -> None:
    origin = OriginRecord(authors=["Knuth, Donald", "A & B Institute"], last_frame="2026-03-01T00:00:00+00:00")
    entry = bibtex("Canon EOS 550D", 707, "croplab 0.1.0", "ab" * 32, origin)
    assert "author = {Knuth, Donald and {A \\& B Institute}}" in entry
    assert "@misc{knuth-canoneos550d-2026-abababab," in entry
    assert "year = {2026}" in entry
    assert entry.startswith("% not recorded in the LUT: url, licence\n")
    older = bibtex("Canon EOS 550D", 707, "croplab 0.1.0", "ab" * 32, None)
    assert "author =" not in older
    assert "% not recorded in the LUT: author, year, url, licence" in older


def test_escapes_tex_commands() -> None:
    hostile = tex_text(r"50 % \input{x} $a_1$ #~^")
    unescaped = re.sub(r"\\[{}&%$#_]|\\text\w+\{\}", "", hostile)
    assert not re.search(r"[\\{}&%$#_~^]", unescaped)


def test_simulated_table_is_cited_as_simulated() -> None:
    assert "simulated" in bibtex("C", 1, "s", "0" * 64, OriginRecord(rig="simulated"))
    assert "computed" in bibtex("C", 1, "s", "0" * 64, None, computed=True)


def test_table_without_origin_is_not_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "lut")
    assert "origin" not in json.loads((tmp_path / "lut" / "lut.json").read_text())
    assert main(["info", str(tmp_path / "lut")]) == 0
    printed = dict(re.findall(r"^([^:\n]+): +(.*)$", capsys.readouterr().out, re.MULTILINE))
    for name, _ in origin_lines(None):
        assert printed[name] == NOT_RECORDED
    assert main(["info", str(tmp_path / "lut"), "--cite"]) == 0
    printed_entry = capsys.readouterr().out
    assert open_lut(tmp_path / "lut").sha256 in printed_entry


def test_origin_survives_file() -> None:
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


def test_address_cannot_end_entry() -> None:
    origin = OriginRecord(url="https://doi.example/10.1/{a}\\b\n c")
    assert "url = {https://doi.example/10.1/abc}," in bibtex("Test", 3, "croplab", "0" * 64, origin)


def test_counts_bodies_with_withheld_serials() -> None:
    origins = [FrameOrigin("Test", serial) for serial in ("7", "8", "7")]
    published = [one.serial for one in with_published_serials(origins, "withheld")]
    assert published == ["withheld (1)", "withheld (2)", "withheld (1)"]


def test_reads_citation_from_session(session: Session, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shutil.copytree(session.folder, tmp_path / "session")
    settings = tmp_path / "session" / "session.toml"
    for licence, stated in (("CC-BY-4.0", True), ("free as air", False)):
        citation = {"authors": ["Ban, N."], "licence": licence}
        settings.write_text(tomli_w.dumps({"rig": "imported", "citation": citation}))
        with Session.open(tmp_path / "session") as opened:
            result = stated_origin(opened).citation
        assert (result.authors == ("Ban, N.",)) == stated
        assert ("citation: licence" in caplog.text) == (not stated)
