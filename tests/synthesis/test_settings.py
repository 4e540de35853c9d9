"""Settings of computed tables: what a file says, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from foundation.errors import ConfigurationError
from sim.world.sensors import FACTS, find_body
from synthesis.settings import TableSettings, load_settings, origin_of, parse_settings, room_of

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


def test_a_file_changes_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text(FILE)
    settings = load_settings(path)
    assert (settings.seed, settings.window, settings.exposure.iso, settings.exposure.shutter_s) == (3, 7, 400, 0.5)
    room = room_of(settings, "here")
    assert (room.seed, room.vignetting, room.profile, room.lamp_drift_per_hour) == (3, 0.1, "managed", 0)
    body = find_body("Canon_EOS_5DS", settings.camera, "here")
    assert (body.model, body.electrons_per_dn, body.saturation) == ("Maker M2", 2.5, FACTS["Canon_EOS_5DS"].saturation)
    assert body.half_size == (2000, 3000)
    assert body.sensitivities == "Canon_EOS_5DS"


@pytest.mark.parametrize(
    ("section", "name", "least", "most"),
    [("exposure", "iso", 50, 25600), ("chart", "bits", 1, 5), ("chart", "seed", 0, None), ("", "seed", 0, None)],
)
def test_numbers_at_their_limits_and_beyond(section: str, name: str, least: int, most: int | None) -> None:
    def parsed(number: int) -> TableSettings:
        return parse_settings({section: {name: number}} if section else {name: number}, "here")

    for limit, beyond in ((least, least - 1), *([(most, most + 1)] if most else [])):
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
def test_what_cannot_be_set_is_refused(document: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_settings(document, "here")


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"modell": "x"}, r"unknown key 'camera\.modell'; did you mean 'model'"),
        ({"black": "x"}, r"camera\.black: "),
        ({"black": 20000}, r"camera\.black is 20000; 0 to below saturation"),
        ({"black": -1}, r"camera\.black is -1; 0 to below saturation"),
        ({"read_noise_dn": -0.01, "sensor_noise_e": 0.0}, r"camera\.read_noise_dn is -0\.01; 0 or more"),
        ({"saturation": 20000}, r"camera\.saturation is 20000; 16383 at most with 14 bits"),
        ({"electrons_per_dn": 0}, r"camera\.electrons_per_dn is 0; more than 0"),
        ({"sensor_noise_e": 99.0}, r"camera\.sensor_noise_e is 99; 0 to the whole read noise"),
        ({"pixels": [10]}, r"camera\.pixels = \[10\]: two whole numbers"),
        ({"pixels": [4, 4]}, "at least 16 columns and rows"),
        ({"pattern": "RGBW"}, "pattern is 'RGBW'"),
    ],
)
def test_what_no_sensor_has_is_refused(camera: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        find_body("Canon_EOS_600D", camera, "here")


def test_a_citation_is_recorded_and_devices_have_no_place_in_it() -> None:
    stated = {"authors": ["Lovelace, Ada"], "licence": "cc-by-4.0", "title": "A table"}
    origin = origin_of(parse_settings({"citation": stated}, "here"), "here")
    assert origin is not None
    assert (origin.authors, origin.licence, origin.title) == (["Lovelace, Ada"], "CC-BY-4.0", "A table")
    assert origin_of(TableSettings(), "here") is None
    for key in ("lens", "projector", "camera_serial"):
        document = {"citation": {key: "plain"}}
        with pytest.raises(ConfigurationError, match=rf"here: citation\.{key}"):
            origin_of(parse_settings(document, "here"), "here")
