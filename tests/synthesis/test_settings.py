"""Settings of computed LUTs: values of a file, and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from foundation.errors import ConfigurationError
from sim.world.sensors import SENSITIVITY_BODIES, find_body
from synthesis.settings import TableSettings, citation_record, load_settings, parse_settings, table_room

FILE = """
seed = 3
window = 7

[camera]
model = "Maker M2"
pixels = [6000, 4000]
electrons_per_dn = 2.5

[exposure]
iso = 400

[room]
vignetting = 0.1
profile = "managed"
"""


def test_file_changes_the_named_settings(tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text(FILE)
    settings = load_settings(path)
    assert (settings.seed, settings.window, settings.exposure.iso, settings.exposure.shutter_s) == (3, 7, 400, 0.5)
    room = table_room(settings, "here")
    assert (room.seed, room.vignetting, room.profile, room.lamp_drift_per_hour) == (3, 0.1, "managed", 0)
    body = find_body("Canon_EOS_5DS", settings.camera, "here")
    saturation = SENSITIVITY_BODIES["Canon_EOS_5DS"].saturation
    assert (body.model, body.electrons_per_dn, body.saturation) == ("Maker M2", 2.5, saturation)
    assert body.half_size == (2000, 3000)
    assert body.sensitivities == "Canon_EOS_5DS"


@pytest.mark.parametrize(
    ("section", "name", "minimum", "maximum"),
    [("exposure", "iso", 50, 25600), ("chart", "bits", 1, 5), ("chart", "seed", 0, None), ("", "seed", 0, None)],
)
def test_checks_the_limits_of_numbers(section: str, name: str, minimum: int, maximum: int | None) -> None:
    def parsed(number: int) -> TableSettings:
        return parse_settings({section: {name: number}} if section else {name: number}, "here")

    for limit, beyond in ((minimum, minimum - 1), *([(maximum, maximum + 1)] if maximum else [])):
        settings = parsed(limit)
        assert getattr(getattr(settings, section) if section else settings, name) == limit
        with pytest.raises(ConfigurationError, match=rf"{name} = {beyond}"):
            parsed(beyond)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"sead": 1}, "unknown key 'sead'; did you mean 'seed'"),
        ({"exposure": {"isso": 100}}, r"unknown key 'exposure\.isso'; did you mean 'iso'"),
        ({"exposure": {"shutter_s": float("inf")}}, r"exposure\.shutter_s = inf"),
    ],
)
def test_refuses_unknown_settings(document: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_settings(document, "here")


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"modell": "x"}, r"unknown key 'camera\.modell'; did you mean 'model'"),
        ({"black": "x"}, r"camera\.black = "),
        ({"black": 20000}, r"camera\.black is 20000, expected 0 to below saturation"),
        ({"black": -1}, r"camera\.black is -1, expected 0 to below saturation"),
        ({"read_noise_dn": -0.01, "sensor_noise_e": 0.0}, r"camera\.read_noise_dn is -0\.01, expected 0 or more"),
        ({"saturation": 20000}, r"camera\.saturation is 20000, expected at most 16383 with 14 bits"),
        ({"electrons_per_dn": 0}, r"camera\.electrons_per_dn is 0, expected more than 0"),
        ({"sensor_noise_e": 99.0}, r"camera\.sensor_noise_e is 99, expected 0 to the whole read noise"),
        ({"pixels": [10]}, r"camera\.pixels = \[10\]: expected two whole numbers"),
        ({"pixels": [4, 4]}, "at least 16 columns and rows"),
        ({"pattern": "RGBW"}, "pattern is 'RGBW'"),
    ],
)
def test_refuses_impossible_sensors(camera: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        find_body("Canon_EOS_600D", camera, "here")


def test_records_the_citation_without_devices() -> None:
    stated = {"authors": ["Lovelace, Ada"], "licence": "cc-by-4.0", "title": "A table"}
    origin = citation_record(parse_settings({"citation": stated}, "here"), "here")
    assert origin is not None
    assert (origin.authors, origin.licence, origin.title) == (["Lovelace, Ada"], "CC-BY-4.0", "A table")
    assert citation_record(TableSettings(), "here") is None
    for key in ("lens", "projector", "camera_serial"):
        document = {"citation": {key: "plain"}}
        with pytest.raises(ConfigurationError, match=rf"here: citation\.{key}"):
            citation_record(parse_settings(document, "here"), "here")
