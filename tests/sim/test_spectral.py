"""Spectra, sensitivities and print models: resampling, published values, refusals."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import colour
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.raw.rawfile import camera_matrix
from foundation.colorimetry import XYZ_TO_SRGB, angles_deg, observer_cie_1931
from foundation.errors import FormatError, InputError
from sim import spectral
from sim.spectral import (
    WAVELENGTHS_NM,
    LampSpectrum,
    PaperName,
    ProfileName,
    Sensitivities,
    daylight,
    matrix_record,
    paper,
    parse_sensitivities,
    print_reflectance,
    printed_reflectance,
    projector_primaries,
    published_spectra,
    read_sensitivities,
    require_grid,
    resampled,
)
from sim.world.sensors import SENSITIVITY_BODIES
from tests.data_files import available
from tests.sim.world.lab import intended_lab, relative_lab

NODES = np.arange(380.0, 781.0, 5.0)


def test_interpolates_a_coarser_grid() -> None:
    coarse = np.arange(390.0, 731.0, 10.0)
    values = resampled(coarse, coarse[:, None] ** 1, NODES)[:, 0]
    inside = (NODES >= 390) & (NODES <= 730)
    assert values[inside] == pytest.approx(NODES[inside])
    assert np.count_nonzero(values[~inside]) == 0


@pytest.mark.parametrize("at", [545.3, 546.1, 547.0, 549.9])
def test_keeps_light_and_position_of_a_narrow_line(at: float) -> None:
    fine = np.arange(380.0, 780.05, 0.1)
    line = np.exp(-0.5 * ((fine - at) / 0.3) ** 2)[:, None]
    values = resampled(fine, line, NODES)[:, 0]
    light = float(line.sum()) * 0.1
    assert values.sum() * 5 == pytest.approx(light, rel=1e-3)
    assert (values * NODES).sum() * 5 / light == pytest.approx(at, abs=0.02)


def test_narrow_line_keeps_the_coarse_part_smooth() -> None:
    # Measured every 10 nm, and every 1 nm about a line: nodes between the coarse steps must not stay dark.
    grid = np.unique(np.concatenate([np.arange(380.0, 781.0, 10.0), np.arange(540.0, 551.0)]))
    values = resampled(grid, grid[:, None] / 500, NODES)[:, 0]
    assert values[1:-1] == pytest.approx(NODES[1:-1] / 500, rel=1e-3)


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ([], "its wavelengths are none"),
        ([410, 700], "410 to 700, expected at least 400 to 700 nm"),
        ([400, 420, 420, *range(440, 701, 20)], "420 nm occurs twice"),
        ([400, *range(425, 701, 5)], "a gap from 400 to 425 nm"),
    ],
)
def test_refuses_incomplete_grids(grid: list[float], message: str) -> None:
    with pytest.raises(FormatError, match=f"lamp: .*{message}"):
        require_grid(np.array(grid, dtype=np.float64), "lamp")


# They import colour-science, which takes more than a second.


@pytest.mark.slow
def test_published_lights_are_unchanged() -> None:
    families: tuple[Any, ...] = (colour.SDS_ILLUMINANTS, colour.SDS_LIGHT_SOURCES)
    theirs: dict[str, Any] = {str(name): light for family in families for name, light in family.items()}
    values = published_spectra()
    assert set(values) == set(theirs)
    for name, light in values.items():
        assert light.wavelengths_nm == pytest.approx(theirs[name].wavelengths, abs=1e-9), name
        assert np.array_equal(light.power, theirs[name].values), name


@pytest.mark.slow
@pytest.mark.parametrize("cct_k", [4000, 5003, 6504, 7000, 7001, 12_000, 25_000])
def test_daylight_equals_the_cie(cct_k: float) -> None:
    theirs = colour.sd_CIE_illuminant_D_series(colour.temperature.CCT_to_xy_CIE_D(cct_k))
    assert daylight(cct_k).power == pytest.approx(theirs.values, abs=1e-9)
    assert np.array_equal(daylight(cct_k).wavelengths_nm, theirs.wavelengths)


def document(step: float = 10, low: float = 390, high: float = 720, **changes: Any) -> dict[str, Any]:
    grid = np.arange(low, high + 1, step)
    peaks = np.array([600.0, 540.0, 460.0])
    curves = np.exp(-0.5 * ((grid[:, None] - peaks) / 28) ** 2)
    table = {f"{at:g}": row for at, row in zip(grid, curves.tolist(), strict=True)}
    spectra = {"units": "relative", "index": {"main": ["R", "G", "B"]}, "data": {"main": table}}
    return {"header": {"manufacturer": "Maker", "model": "M1"}, "spectral_data": spectra | changes}


def parsed(content: Any) -> Any:
    return parse_sensitivities(json.dumps(content).encode(), "m1", "m1.json")


def test_sensitivities_are_interpolated_and_zero_outside() -> None:
    values = parsed(document())
    assert values.camera == "Maker M1"
    at = values.at(WAVELENGTHS_NM)[[0, 15, 16, 80]]
    assert at[0].tolist() == at[3].tolist() == [0, 0, 0]
    middle = (values.curves[values.wavelengths_nm == 450] + values.curves[values.wavelengths_nm == 460])[0] / 2
    assert at[1] == pytest.approx(middle)
    assert at[2, 2] == 1


def altered(key: str, value: Any) -> dict[str, Any]:
    content = document()
    table = content["spectral_data"]["data"]["main"]
    if value is None:
        for at in key.split():
            del table[at]
    else:
        table[key] = value
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "expected the format of rawtoaces"),
        ({"spectral_data": {}}, r"spectral_data\.index: Field required"),
        (document(units="quantum efficiency"), "units is 'quantum efficiency', expected 'relative'"),
        (document(index={"main": ["X", "Y", "Z"]}), r"index\.main is \['X', 'Y', 'Z'\]"),
        (altered("500 510 520", None), "a gap from 490 to 530 nm, expected at most 20 nm"),
        (altered("500", [0.1, -0.2, 0.1]), "G is -0.2 at 500 nm, expected 0 or more"),
        (altered("500", [0.1, 0.2]), r"at 500 nm are \[0.1, 0.2\], expected three numbers"),
        (altered("blue", [0.1, 0.2, 0.3]), "the wavelength is 'blue'"),
        (altered("500.0", [0.1, 0.2, 0.3]), "500 nm occurs twice"),
        (document(low=420), "its wavelengths are 420 to 720, expected at least 400 to 700 nm"),
        (document(low=0.39, high=0.72, step=0.01), "convert them to nanometres"),
        (altered("390", [0, 0, 0.3]), "B has 30% of its peak at the end of its range, 390 nm"),
        (altered("720", [0.051, 0, 0]), "R has 5% of its peak at the end of its range, 720 nm"),
    ],
)
def test_refuses_bad_sensitivities(content: Any, message: str) -> None:
    assert parsed(altered("720", [0.05, 0, 0])).curves[-1, 0] == 0.05, "5 % at the end is allowed"
    with pytest.raises(FormatError, match=message) as refused:
        parsed(content)
    assert str(refused.value).startswith("m1.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (json.dumps(document()).replace('"500"', '"490"'), "'490' occurs twice"),
        ("[" * 100_000, "is not JSON"),
    ],
)
def test_refuses_bad_json(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        parse_sensitivities(text.encode(), "m1", "m1.json")


def test_unknown_camera_is_answered_with_near_names_and_a_way_to_add_it() -> None:
    near = r"did you mean 'Canon_EOS_5DS'.*--camera list.*path of a JSON file.*rawtoaces-data"
    with pytest.raises(InputError, match=near):
        read_sensitivities("canon eos 5d s")
    with pytest.raises(InputError, match="no such file; sim table --camera list"):
        read_sensitivities("x")


def test_matrix_of_a_camera_like_the_observer_is_exact() -> None:
    # Sensitivities that are mixtures of the colour-matching functions have an exact matrix (Luther condition).
    mix = np.array([[0.6, 0.5, 0.1], [0.1, 0.9, 0.2], [0.0, 0.1, 0.8]])
    grid, functions = observer_cie_1931()
    curves = resampled(grid, functions, WAVELENGTHS_NM) @ mix.T
    record = matrix_record(Sensitivities("m1", "", "", WAVELENGTHS_NM, curves, ""))
    expected = mix @ np.linalg.inv(XYZ_TO_SRGB)
    np.testing.assert_allclose(record["rows"], expected / expected.sum(axis=1, keepdims=True), atol=2e-4)
    assert record["source"].endswith("median residual 0.0 degrees")


@pytest.mark.parametrize("name", sorted(SENSITIVITY_BODIES))
def test_matrix_is_near_the_one_of_the_maker(name: str) -> None:
    listed = camera_matrix(SENSITIVITY_BODIES[name].camera)
    assert listed is not None
    maker = np.array(listed) @ np.linalg.inv(XYZ_TO_SRGB)
    computed = np.array(matrix_record(read_sensitivities(name))["rows"])
    linear = np.random.default_rng(1).random((1000, 3))
    angles = angles_deg(linear @ (maker / maker.sum(axis=1, keepdims=True)).T, linear @ computed.T)
    # Makers measured another body; the five cameras differ by 0.8 to 2.3 degrees.
    assert np.median(angles) < 2.5


def test_reflectances_equal_the_published_ones() -> None:
    theirs: Any = colour.SDS_COLOURCHECKERS["ColorChecker N Ohta"]
    ours = spectral.published_reflectances()
    assert list(ours) == list(theirs)
    for name, patch in ours.items():
        np.testing.assert_array_equal(patch.wavelengths_nm, theirs[name].wavelengths)
        np.testing.assert_array_equal(patch.power, theirs[name].values)


PAPERS: tuple[PaperName, ...] = ("poster", "matt", "glossy")
MANAGED: tuple[PaperName, ...] = ("poster", "glossy")
"""Papers with profiles computed here, each in a second: the one with the least black, and the one with most."""
GREYS = np.repeat(np.arange(256)[:, None], 3, axis=1)


@cache
def grey_lab(profile: ProfileName, on: PaperName) -> NDArray[np.float64]:
    """Return CIELAB of all greys under D50, relative to paper."""
    return relative_lab(printed_reflectance(GREYS, profile, on), on)


def difference(target: NDArray[np.float64], lab: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(colour.delta_E(target, lab, method="CIE 2000"), dtype=np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("on", PAPERS)
def test_unmanaged_greys_have_the_measured_tint(on: PaperName) -> None:
    # Papers printed without colour management (head of `sim.world.world`): the largest chroma is 5 to 14, but for one
    # printer, an Epson P800, whose driver balances its greys (1.3).
    lab = grey_lab("unmanaged", on)
    assert 5 < np.hypot(lab[:, 1], lab[:, 2]).max() < 14
    assert np.diff(lab[:, 0]).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize("on", MANAGED)
def test_managed_print_has_the_colours_of_the_file(on: PaperName) -> None:
    rng = np.random.default_rng(3)
    pale = 128 + rng.integers(-40, 41, (400, 3))
    deltas = difference(intended_lab(pale, on), relative_lab(printed_reflectance(pale, "managed", on), on))
    assert np.median(deltas) < 0.3
    assert deltas.max() < 2.5


@pytest.mark.slow
def test_srgb_matrix_is_adapted_to_d50() -> None:
    space = colour.RGB_COLOURSPACES["sRGB"]
    whites: Any = [colour.xy_to_XYZ(xy) for xy in (space.whitepoint, (0.3457, 0.3585))]
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, transform="Bradford")
    values = spectral._SRGB_TO_D50
    np.testing.assert_allclose(values, adapt @ space.matrix_RGB_to_XYZ, atol=2e-4)


LAMPS: tuple[LampSpectrum, ...] = ("uhp", "led")


def absolute_lab(reflectance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return CIELAB (N, 3) under D50 relative to an ideal white, as instruments report it."""
    shape = colour.SpectralShape(380, 780, 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    light = observer * colour.SDS_ILLUMINANTS["D50"].copy().align(shape).values[:, None]
    white = light.sum(axis=0)
    chromaticity = (white / white.sum())[:2]
    xyz = reflectance @ light / white[1]
    return np.asarray(colour.XYZ_to_Lab(xyz, chromaticity), dtype=np.float64)


def measured(path: Path) -> dict[str, NDArray[np.float64]]:
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, dtype=np.float64)
    return {name: values[:, i] for i, name in enumerate(header)}


def interpolated(
    at: NDArray[np.float64], where: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(np.interp(at, where, values), dtype=np.float64)


@pytest.mark.parametrize("lamp", LAMPS)
def test_projector_white_is_near_d65(lamp: LampSpectrum) -> None:
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(colour.SpectralShape(380, 780, 5))
    white = projector_primaries(lamp).sum(axis=0) @ observer.values
    np.testing.assert_allclose((white / white.sum())[:2], [0.3127, 0.3290], atol=0.02)


def bell(peak_nm: float, width_nm: float) -> dict[str, NDArray[np.float64]]:
    """Return a Gaussian with its full width at half maximum, in the format of a measured primary."""
    wavelength = np.arange(380.0, 781.0, 4.0)
    power = np.exp(-4 * np.log(2) * ((wavelength - peak_nm) / width_nm) ** 2)
    return {"wavelength_nm": wavelength, "power (median of 7 scans)": power}


# Peaks and widths that `sim.world.world` documents of the measured primaries, and the curves where they are found.
LED_PRIMARIES = {
    "red": (0, lambda: bell(632, 19)),
    "green": (1, lambda: bell(516, 34)),
    "blue": (2, lambda: bell(452, 21)),
} | {
    path.stem: (index, partial(measured, path))
    for index, name in enumerate(("r255g0b0o0", "r0g255b0o0", "r0g0b255o0"))
    for path in available(f"projector/{name}_median.csv")
}


@pytest.mark.parametrize(("lamp_index", "table_of"), LED_PRIMARIES.values(), ids=LED_PRIMARIES)
def test_led_primaries_resemble_a_measured_led_projector(
    lamp_index: int, table_of: Callable[[], dict[str, NDArray[np.float64]]]
) -> None:
    table = table_of()
    wavelength, power = table["wavelength_nm"], table["power (median of 7 scans)"]
    lab_of_code = interpolated(wavelength, WAVELENGTHS_NM, projector_primaries("led")[lamp_index])
    assert abs(wavelength[power.argmax()] - wavelength[lab_of_code.argmax()]) <= 4
    overlap = float(lab_of_code @ power / np.sqrt((lab_of_code @ lab_of_code) * (power @ power)))
    assert overlap > 0.98


def documented_paper() -> dict[str, NDArray[np.float64]]:
    """Return the documented values of measured photo paper."""
    # Between 450 and 600 nm the white falls evenly; the inks are given as densities over white.
    white = np.array([0.64, 0.93, 0.882, 0.85])
    return {
        "wavelength_nm": np.array([400.0, 450, 540, 600]),
        "white": white,
        "yellow_4/4": white * 10 ** -np.array([1.25, 1.25, np.nan, np.nan]),
        "m_4/4": white * 10 ** -np.array([np.nan, 0.2, 1.17, np.nan]),
    }


MEASURED_PAPERS = {"documented": documented_paper} | {
    path.stem: partial(measured, path) for path in available("print/photo_paper_reflectance.csv")
}


@pytest.mark.parametrize("table_of", MEASURED_PAPERS.values(), ids=MEASURED_PAPERS)
def test_paper_and_inks_resemble_measured_photo_paper(table_of: Callable[[], dict[str, NDArray[np.float64]]]) -> None:
    table = table_of()
    at = table["wavelength_nm"]

    def lab_of_code(code: list[int]) -> NDArray[np.float64]:
        return interpolated(at, WAVELENGTHS_NM, print_reflectance([code])[0])

    assert np.abs(lab_of_code([255, 255, 255]) - table["white"]).max() < 0.05
    assert np.nanmean(np.abs(lab_of_code([255, 255, 0]) - table["yellow_4/4"])) < 0.05
    assert np.nanmean(np.abs(lab_of_code([255, 0, 255]) - table["m_4/4"])) < 0.06


# CIELAB (D50, CIE 1931, ideal white) of solids that an Epson XP-960 printed without colour management, computed from
# the measured spectra that the head of `sim.world.world` names.
SOLID_CODES = [[255] * 3, [0, 255, 255], [255, 0, 255], [255, 255, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255], [0] * 3]
SOLID_LAB: dict[PaperName, list[list[int]]] = {
    "matt": [[96, 0, -1], [50, -27, -56], [50, 78, -11], [90, 1, 104], [49, 69, 51], [41, -56, 27], [22, 30, -50],
             [15, 0, -3]],
    "glossy": [[95, -1, -2], [51, -38, -58], [50, 82, -17], [89, -4, 109], [49, 72, 67], [41, -80, 34], [15, 43, -65],
               [5, 2, -4]],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("on", SOLID_LAB)
def test_solids_of_photo_papers_look_like_measured_ones(on: PaperName) -> None:
    white = relative_lab(print_reflectance([[255] * 3], on), on)
    np.testing.assert_allclose(white, [[100, 0, 0]], atol=1e-6)
    lab = absolute_lab(print_reflectance(SOLID_CODES, on))
    deltas = colour.delta_E(np.array(SOLID_LAB[on], dtype=np.float64), lab, method="CIE 2000")
    assert deltas.max() < 4.5
    assert np.mean(deltas) < 2.5


@pytest.mark.parametrize("on", PAPERS)
def test_overprints_follow_demichel_and_yule_nielsen(on: PaperName) -> None:
    """A coverage of 0.5 is 0.64 with dot gain; Demichel's weights, Yule-Nielsen with n = 2."""
    inked = paper(on)
    below = (inked.white - inked.surface) / (1 - inked.surface)
    cyan, magenta = inked.inks[0], inked.inks[1]
    mixed = np.sqrt(below) * (
        0.36 * 0.36
        + 0.64 * 0.36 * (10 ** (-cyan / 2) + 10 ** (-magenta / 2))
        + 0.64 * 0.64 * 10 ** (-(cyan + magenta) / 2)
    )
    seen_under_white = print_reflectance([[127.5, 127.5, 255]], on)[0]
    np.testing.assert_allclose(seen_under_white, inked.surface + (1 - inked.surface) * mixed**2)
