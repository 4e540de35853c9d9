"""`sim table`: what it takes and prints; the devices beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibration.table.lut import open_lut
from synthesis.cli import main

SMALL = "[chart]\nbits = 1\n"


@pytest.fixture
def settings(tmp_path: Path) -> str:
    path = tmp_path / "table.toml"
    path.write_text(SMALL)
    return str(path)


def test_a_table_comes_of_one_command(settings: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lut"
    given = ["--camera", "Canon_EOS-1Ds_Mark_III", "--lights", "D65,A", "--paper", "matt", "--hot", "5", "--seed", "4"]
    assert main(["table", str(out), "--settings", settings, *given]) == 0
    assert capsys.readouterr().out == (
        f"{out}: computed, 2 lights, 8 colours, 25 samples each; 0 cells unfit for use\n"
    )
    computed = open_lut(out).provenance.computed
    assert computed is not None
    assert (computed["seed"], computed["room"]["paper"], computed["room"]["hot_per_million"]) == (4, "matt", 5)
    assert computed["room"]["profile"] == "unmanaged"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--camera", "Canon_EOS_1"], "no camera 'Canon_EOS_1'"),
        (["--lights", "D66"], "no published light 'D66'"),
        (["--paper", "silk"], "the command line: room.paper"),
        (["--settings", "none.toml"], "cannot read settings none.toml"),
    ],
)
def test_what_cannot_be_computed_is_one_sentence(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["table", str(tmp_path / "lut"), *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "lut").exists()


def test_the_devices_are_beside_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["projector"]) == 2
    assert "one projector has one cable" in capsys.readouterr().err
