"""Spectra of illuminants: files, published spectra, black bodies, refusals; computed sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiment.lights import blackbody_light, shown_colour
from foundation.errors import FormatError, InputError
from sim.spectral import WAVELENGTHS_NM
from sim.world.sensors import BODIES, Rectangle
from sim.world.world import Room
from synthesis.lamps import PatchSensor, parse_spectra, read_lights, table_illuminants


def table(step: int = 5, low: int = 380, high: int = 780, **lights: float) -> str:
    """Return a CSV file of constant spectra with these powers."""
    rows = [",".join(["wavelength", *lights])]
    rows += [",".join([str(at), *map(str, lights.values())]) for at in range(low, high + 1, step)]
    return "\n".join(rows) + "\n"


def test_reads_a_light_from_each_column(tmp_path: Path) -> None:
    path = tmp_path / "lamps.csv"
    path.write_text(table(hall=2.0, stage=7.0), encoding="utf-8-sig")
    spectra = read_lights(str(path))
    assert [light.name for light in spectra.lights] == ["hall", "stage"]
    # Proportions within a light count, its brightness does not.
    assert np.array_equal(spectra.lights[0].power, np.ones(81))
    assert np.array_equal(spectra.lights[1].power, np.ones(81))
    assert spectra.source["file"] == "lamps.csv"
    assert len(spectra.source["sha256"]) == 64


@pytest.mark.parametrize(("step", "low", "high"), [(1, 380, 780), (5, 400, 700), (10, 350, 900), (20, 400, 700)])
def test_light_does_not_depend_on_the_grid(step: int, low: int, high: int) -> None:
    (light,) = parse_spectra(table(step, low, high, hall=3.0).encode(), "lamps.csv")
    inside = (max(low, 380) + 5 < WAVELENGTHS_NM) & (min(high, 780) - 5 > WAVELENGTHS_NM)
    assert light.power[inside] == pytest.approx(np.ones(int(inside.sum())))
    beyond = (low - 5 > WAVELENGTHS_NM) | (high + 5 < WAVELENGTHS_NM)
    assert not light.power[beyond].any()


def test_published_illuminants_equal_the_cie() -> None:
    lamps = {light.name: light for light in read_lights("A,D65,FL2,LED-B3").lights}
    # CIE 15, illuminants A and D65: relative power at 400, 500, 560 and 700 nm, over that at 560 nm.
    at = np.searchsorted(WAVELENGTHS_NM, [400, 500, 560, 700])
    assert lamps["A"].power[at] / lamps["A"].power[at[2]] == pytest.approx([0.147080, 0.598611, 1, 1.98261], rel=1e-4)
    assert lamps["D65"].power[at] / lamps["D65"].power[at[2]] == pytest.approx(
        [0.827549, 1.09354, 1, 0.716091], rel=1e-4
    )
    assert all(light.cct_k is None for light in lamps.values())


def test_black_body_follows_planck_and_keeps_its_temperature() -> None:
    lights = read_lights("2000:10000:4000K").lights
    assert [light.cct_k for light in lights] == [2000, 6000, 10_000]
    planck = [w**-5 / np.expm1(1.4387769e7 / (w * 6000)) for w in (450.0, 650.0)]
    at = np.searchsorted(WAVELENGTHS_NM, [450, 650])
    assert lights[1].power[at[0]] / lights[1].power[at[1]] == pytest.approx(planck[0] / planck[1], rel=2e-3)
    illuminations = table_illuminants(lights)
    assert [light.kind for light in illuminations] == ["blackbody"] * 3
    # The projector's black body of the same temperature has the same codes, to rounding.
    for light, cct_k in zip(illuminations, (2000, 6000, 10_000), strict=True):
        expected = shown_colour(blackbody_light(cct_k))
        assert np.abs(np.subtract(light.colour, (expected.red, expected.green, expected.blue))).max() <= 1


def test_accepts_sets_and_daylight_of_any_temperature() -> None:
    assert [light.name for light in read_lights("cie-hp").lights] == ["HP1", "HP2", "HP3", "HP4", "HP5"]
    assert len(read_lights("cie").lights) == 52
    (light,) = read_lights("daylight:6504").lights
    (d65,) = read_lights("D65").lights
    assert np.abs(light.power - d65.power).max() < 0.01


@pytest.mark.parametrize(("at", "is_light"), [(395, False), (400, True), (700, True), (705, False)])
def test_requires_power_from_400_to_700_nm(at: int, is_light: bool) -> None:
    text = table(hall=0.0).replace(f"{at},0.0", f"{at},3.0")
    if is_light:
        (light,) = parse_spectra(text.encode(), "lamps.csv")
        np.testing.assert_array_equal(light.power, at == WAVELENGTHS_NM)
        return
    with pytest.raises(FormatError):
        parse_spectra(text.encode(), "lamps.csv")


def test_names_a_missing_file() -> None:
    with pytest.raises(InputError, match=r"spectra nowhere\.csv"):
        read_lights("nowhere.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nm,hall\n400,1\n", "its first line is 'nm,hall'"),
        (
            table(hall=1.0).replace("hall", "12"),
            "the name of an illuminant is '12', expected a name with a letter",
        ),
        (table(hall=1.0).replace("500,1.0", "500,-0.1"), "'hall' is -0.1 at 500 nm, expected 0 or more"),
        (table(hall=1.0).replace("500,1.0", "500,"), "line 26: expected 2 numbers"),
        (table(hall=1.0).replace("500,1.0", "500"), "line 26: expected 2 numbers"),
        (table(hall=1.0).replace("500,1.0", "500,nan"), "a value is NaN or infinite"),
        (table(hall=1.0, cellar=0.0), "'cellar' has no power from 400 to 700 nm"),
        (table(low=410, hall=1.0), "its wavelengths are 410 to 780"),
        (table(step=40, hall=1.0), "a gap from 380 to 420 nm"),
        (table(hall=1.0) + "500,2\n", "500 nm occurs twice"),
    ],
)
def test_refuses_bad_spectra(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=rf"lamps\.csv.*{message}"):
        parse_spectra(text.encode(), "lamps.csv")


def test_refuses_binary_data() -> None:
    with pytest.raises(FormatError):
        parse_spectra(b"\xff\xfe\x00", "lamps.csv")


BODY = BODIES["Test"]


EVEN = Room(response_spread=0.0, hot_per_million=0.0)


def test_photosite_has_the_light_of_its_channel_and_patch() -> None:
    sensor = PatchSensor.of(BODY, 2, 3, EVEN, 0.5)
    signals = np.array([[[10.0, 1], [20, 2], [30, 3]], [[40, 4], [50, 5], [60, 6]]])
    light = sensor.light(signals)
    assert light.shape == (3, 2 * 2 * 3, 2 * 3)
    assert BODY.pattern == "RGGB"
    blocks = [np.tile([[red, green], [green, blue]], (3, 3)) for red, green, blue in ((10, 20, 30), (40, 50, 60))]
    np.testing.assert_array_equal(light[0], np.concatenate(blocks))
    np.testing.assert_array_equal(light[1], light[0] / 10)
    assert not light[2].any()
    # Half-size pixels: patches of three of them, one below the other.
    assert (sensor.sites.rows.tolist(), sensor.sites.columns.tolist(), sensor.sites.window) == ([1, 4], [1, 1], 3)


def test_response_has_the_spread_of_the_room() -> None:
    response = PatchSensor.of(BODY, 100, 5, replace(EVEN, response_spread=0.02), 0.5).response
    # 10 000 photosites: the mean is known to a hundredth of the spread, the spread to .7 %.
    assert response.mean() == pytest.approx(1, abs=5 * 0.0002)
    assert response.std() == pytest.approx(0.02, rel=5 * 0.007)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("masked", "photosites"),
    [
        ((), None),
        ((Rectangle(0, 0, 20, 4),), None),
        ((Rectangle(0, 0, 20, 14),), 20 * 10 / 4),
        ((Rectangle(0, 0, 20, 14), Rectangle(0, 20, 10, 8)), (20 * 10 + 10 * 4) / 4),
    ],
)
def test_black_level_error_depends_on_masked_area(masked: tuple[Rectangle, ...], photosites: float | None) -> None:
    """Four columns at each border are not used; each position of the pattern has a quarter."""
    body = replace(BODY, masked=masked, read_noise_dn=0.3, sensor_noise_e=0.0)
    sensor = PatchSensor.of(body, 1, 3, EVEN, 0.5)
    dark = np.zeros((3, 6, 6), np.float32)
    frames = range(400)
    errors = np.array([sensor.expose(dark, np.ones(3), 400, frame)[1] for frame in frames]) - body.black
    if photosites is None:
        assert not errors.any()
        return
    # The variances of read noise and of rounding to whole counts; 1600 numbers tell a spread to 1.8 %.
    error = np.sqrt((0.09 + 1 / 12) / photosites)
    assert errors.std() == pytest.approx(error, rel=4 * 0.018)
    assert abs(errors.mean()) < 4 * error / 40
