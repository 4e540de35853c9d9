"""The command `sim table`: arguments and output."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from calibration.cli import main as build_lut
from calibration.table.lut import open_lut
from sim.spectral import known_sensitivities, matrix_record, read_sensitivities
from sim.world.sensors import BODIES
from synthesis.cli import main

SMALL = "[chart]\nbits = 1\n"


@pytest.fixture
def settings(tmp_path: Path) -> str:
    path = tmp_path / "table.toml"
    path.write_text(SMALL)
    return str(path)


@pytest.mark.slow
def test_computes_a_lut(settings: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lut"
    Path(settings).write_text("seed = 4\n[room]\npaper = 'matt'\nhot_per_million = 5.0\n" + SMALL)
    options = ["--camera", "Canon_EOS-1Ds_Mark_III", "--lights", "D65,A"]
    assert main(["table", str(out), "--settings", settings, *options]) == 0
    assert capsys.readouterr().out == (f"{out}: computed, 2 illuminants, 8 colours, 25 samples each; 0 unfit patches\n")
    computed = open_lut(out).provenance.computed
    assert computed is not None
    assert (computed["seed"], computed["room"]["paper"], computed["room"]["hot_per_million"]) == (4, "matt", 5)
    assert computed["room"]["profile"] == "unmanaged"
    assert computed["matrix"] == matrix_record(read_sensitivities("Canon_EOS-1Ds_Mark_III"))


@pytest.mark.slow
def test_records_and_prints_the_citation(settings: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lut"
    citation = "note = 'for a course'\nlicence = 'CC-BY-4.0'\nauthors = ['Lovelace, Ada', 'An Institute']\n"
    Path(settings).write_text(f"{SMALL}[citation]\n{citation}")
    assert main(["table", str(out), "--settings", settings, "--lights", "D65"]) == 0
    origin = open_lut(out).provenance.origin
    assert origin is not None
    assert (origin.note, origin.licence) == ("for a course", "CC-BY-4.0")
    assert origin.authors == ["Lovelace, Ada", "An Institute"]
    assert (origin.rig, origin.frames, origin.last_frame) == (None, 0, None)
    assert build_lut(["info", str(out), "--cite"]) == 0
    cited = capsys.readouterr().out
    assert "author = {Lovelace, Ada and {An Institute}}" in cited
    assert "licence CC-BY-4.0" in cited
    assert "Look-up table, computed" in cited
    assert build_lut(["info", str(out)]) == 0
    assert "for a course" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--camera", "Canon_EOS_1"], "no camera 'Canon_EOS_1'"),
        (["--camera", "Nikon_D810"], "sim table --camera list"),
        (["--settings", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_refuses_bad_arguments(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["table", str(tmp_path / "lut"), *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "lut").exists()


def test_lists_cameras_with_sources(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["table", "--camera", "list"]) == 0
    rows = [re.split(r"  +", line) for line in capsys.readouterr().out.splitlines()]
    assert ["Canon_EOS-1Ds_Mark_III", "Canon EOS-1Ds Mark III", "measured, rawtoaces-data"] in rows
    assert ["EOS 550D", "Canon EOS 550D", "simulated with Canon_EOS_600D"] in rows
    assert main(["table", "--camera", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["cameras"]
    assert {*known_sensitivities(), *BODIES} == {camera["name"] for camera in listed}


def test_requires_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["table"]) == 2
    assert "OUT is missing" in capsys.readouterr().err


def test_also_has_the_device_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["projector"]) == 2
    assert "exactly one of --pjlink PORT and --serial LANGUAGE" in capsys.readouterr().err
