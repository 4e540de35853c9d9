"""LAB.toml: every mistake is one sentence that names the key, the value and the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from acquisition.config import load_lab, parse_lab
from acquisition.run.shutter import require_whole_turns
from foundation.errors import ConfigurationError

MINIMAL = 'rig = "simulated"\nchart = "c/chart.json"\nilluminations = "lights.csv"\n'


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    lab = tmp_path / "LAB.toml"
    lab.write_text(MINIMAL)
    settings = load_lab(lab)
    assert settings.chart == tmp_path.resolve() / "c/chart.json"
    assert settings.illuminations == tmp_path.resolve() / "lights.csv"


def test_settings_as_used_read_back_equal() -> None:
    settings = parse_lab(MINIMAL + "[camera]\niso = 200\n[simulated.room]\nwaviness_mm = 6.0\n", "LAB.toml")
    again = parse_lab(settings.to_toml(), "session.toml")
    assert again.read_from("LAB.toml") == settings
    assert again.camera.iso == 200
    assert again.simulated.room == {"waviness_mm": 6.0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (MINIMAL + "[camera]\nshuter_s = 1\n", "unknown key 'camera.shuter_s'; did you mean 'shutter_s'?"),
        (MINIMAL + "[camra]\niso = 1\n", "unknown key 'camra'; did you mean 'camera'?"),
        (MINIMAL + "[sequence]\nxyzzy = 1\n", "known are attempts"),
        (MINIMAL + "[camera]\niso = -5\n", "camera.iso = -5"),
        (MINIMAL + "[camera]\nshutter_s = nan\n", "camera.shutter_s"),
        (MINIMAL + "[camera]\niso = 'fast'\n", "camera.iso = 'fast'"),
        ('rig = "simulated"\n', "chart is missing"),
        (MINIMAL.replace("simulated", "lightsaber"), "rig = 'lightsaber'"),
        ("rig = ", "is not TOML"),
    ],
)
def test_a_mistake_is_named(text: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_lab(text, "LAB.toml")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_replay_needs_a_recording(tmp_path: Path) -> None:
    lab = tmp_path / "LAB.toml"
    lab.write_text(MINIMAL.replace("simulated", "replay"))
    with pytest.raises(ConfigurationError, match=r"\[replay\]"):
        load_lab(lab)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nowhere\.toml"):
        load_lab(tmp_path / "nowhere.toml")


@pytest.mark.parametrize("name", ["demo.toml", "lab.toml"])
def test_the_examples_are_read(name: str) -> None:
    settings = load_lab(Path(__file__).parents[2] / "examples" / name)
    require_whole_turns(settings.camera, settings.lab.projector)
