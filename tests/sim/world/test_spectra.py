"""The spectra are those of real lamps, inks and sensors, as far as measurements at hand tell."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.spectral import (
    WAVELENGTHS_NM,
    LampSpectrum,
    PaperName,
    paper,
    print_reflectance,
    projector_primaries,
    sensitivities,
)
from tests.data_files import available
from tests.sim.world.lab import relative_lab

CAMERAS = ("Canon_EOS_600D", "Canon_EOS_200D")
LAMPS: tuple[LampSpectrum, ...] = ("uhp", "led")
PAPER_NAMES: tuple[PaperName, ...] = ("poster", "matt", "glossy")


def absolute_lab(reflectance: NDArray[np.float64], bare: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return CIELAB (N, 3) under D50 relative to an ideal white, as instruments measure prints; or to a paper's."""
    import colour

    shape = colour.SpectralShape(380, 780, 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    light = observer * colour.SDS_ILLUMINANTS["D50"].copy().align(shape).values[:, None]
    white = light.sum(axis=0)
    chromaticity = (white / white.sum())[:2]
    paper_xyz = white if bare is None else bare @ light
    xyz = reflectance @ light / paper_xyz * white / white[1]
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


def seen(camera: str, lamp: LampSpectrum, codes: NDArray[np.uint8], on: PaperName = "poster") -> NDArray[np.float64]:
    """Return (N, 3) camera RGB of printed codes under the projector's white, 1 for bare paper."""
    light = projector_primaries(lamp).sum(axis=0)[:, None] * sensitivities(camera)
    return (print_reflectance(codes, on) @ light) / (paper(on).white @ light)


@pytest.mark.parametrize("lamp", LAMPS)
def test_the_projectors_white_is_near_d65(lamp: LampSpectrum) -> None:
    # CIE 1931 2° observer, x̄ ȳ z̄ of CIE 018:2019 every 20 nm from 380; D65 is x 0.3127, y 0.3290.
    observer = np.array(
        [
            [0.0014, 0.0000, 0.0065], [0.0143, 0.0004, 0.0679], [0.1344, 0.0040, 0.6456], [0.3483, 0.0230, 1.7471],
            [0.2908, 0.0600, 1.6692], [0.0956, 0.1390, 0.8130], [0.0049, 0.3230, 0.2720], [0.0633, 0.7100, 0.0782],
            [0.2904, 0.9540, 0.0203], [0.5945, 0.9950, 0.0039], [0.9163, 0.8700, 0.0017], [1.0622, 0.6310, 0.0008],
            [0.8544, 0.3810, 0.0002], [0.4479, 0.1750, 0.0000], [0.1649, 0.0610, 0.0000], [0.0468, 0.0170, 0.0000],
            [0.0114, 0.0041, 0.0000], [0.0029, 0.0010, 0.0000], [0.0007, 0.0002, 0.0000], [0.0002, 0.0001, 0.0000],
            [0.0000, 0.0000, 0.0000],
        ]
    )  # fmt: skip
    fine = np.stack([interpolated(WAVELENGTHS_NM, np.arange(380.0, 781, 20), column) for column in observer.T], axis=1)
    white = projector_primaries(lamp).sum(axis=0) @ fine
    np.testing.assert_allclose((white / white.sum())[:2], [0.3127, 0.3290], atol=0.02)


def bell(peak_nm: float, width_nm: float) -> dict[str, NDArray[np.float64]]:
    """Return a Gaussian with its full width at half maximum, in the layout of a measured primary."""
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
    ours = interpolated(wavelength, WAVELENGTHS_NM, projector_primaries("led")[lamp_index])
    assert abs(wavelength[power.argmax()] - wavelength[ours.argmax()]) <= 4
    overlap = float(ours @ power / np.sqrt((ours @ ours) * (power @ power)))
    assert overlap > 0.98


def documented_paper() -> dict[str, NDArray[np.float64]]:
    """Return the values of measured photo paper that `sim.world.world` documents, in the layout of the whole."""
    # Between 450 and 600 nm the white falls evenly; the inks are given as densities over white.
    white = np.array([0.64, 0.93, 0.882, 0.85])
    return {
        "wavelength_nm": np.array([400.0, 450, 540, 600]),
        "white": white,
        "yellow_4/4": white * 10 ** -np.array([1.25, 1.25, np.nan, np.nan]),
        "m_4/4": white * 10 ** -np.array([np.nan, 0.2, 1.17, np.nan]),
    }


PAPERS = {"documented": documented_paper} | {
    path.stem: partial(measured, path) for path in available("print/photo_paper_reflectance.csv")
}


@pytest.mark.parametrize("table_of", PAPERS.values(), ids=PAPERS)
def test_paper_and_inks_resemble_measured_photo_paper(table_of: Callable[[], dict[str, NDArray[np.float64]]]) -> None:
    table = table_of()
    at = table["wavelength_nm"]

    def ours(code: list[int]) -> NDArray[np.float64]:
        return interpolated(at, WAVELENGTHS_NM, print_reflectance([code])[0])

    assert np.abs(ours([255, 255, 255]) - table["white"]).max() < 0.05
    assert np.nanmean(np.abs(ours([255, 255, 0]) - table["yellow_4/4"])) < 0.05
    assert np.nanmean(np.abs(ours([255, 0, 255]) - table["m_4/4"])) < 0.06


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
@pytest.mark.parametrize("on", PAPER_NAMES)
def test_colours_relative_to_paper_are_those_of_the_published_observer_and_light(on: PaperName) -> None:
    reflectance = print_reflectance(SOLID_CODES, on)
    expected = absolute_lab(reflectance, paper(on).white)
    np.testing.assert_allclose(relative_lab(reflectance, on), expected, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("on", SOLID_LAB)
def test_solids_of_photo_papers_look_like_measured_ones(on: PaperName) -> None:
    import colour

    white = relative_lab(print_reflectance([[255] * 3], on), on)
    np.testing.assert_allclose(white, [[100, 0, 0]], atol=1e-6)
    lab = absolute_lab(print_reflectance(SOLID_CODES, on))
    off = colour.delta_E(np.array(SOLID_LAB[on], dtype=np.float64), lab, method="CIE 2000")
    assert off.max() < 4.5
    assert np.mean(off) < 2.5


@pytest.mark.parametrize("on", PAPER_NAMES)
def test_inks_lie_over_each_other_by_chance_and_light_spreads_between_them(on: PaperName) -> None:
    """A half covered is 0.64 covered for dots that grow; Demichel's shares, mixed in the root (Yule-Nielsen, n = 2)."""
    chosen = paper(on)
    below = (chosen.white - chosen.surface) / (1 - chosen.surface)
    cyan, magenta = chosen.inks[0], chosen.inks[1]
    mixed = np.sqrt(below) * (
        0.36 * 0.36
        + 0.64 * 0.36 * (10 ** (-cyan / 2) + 10 ** (-magenta / 2))
        + 0.64 * 0.64 * 10 ** (-(cyan + magenta) / 2)
    )
    seen = print_reflectance([[127.5, 127.5, 255]], on)[0]
    np.testing.assert_allclose(seen, chosen.surface + (1 - chosen.surface) * mixed**2)


@pytest.mark.parametrize("on", SOLID_LAB)
@pytest.mark.parametrize("ink", [0, 1, 2])
def test_ramps_have_the_spectra_of_measured_ramps(ink: int, on: PaperName) -> None:
    """A step of a measured ramp is one of ours at some coverage: which, the printer's driver decides."""
    files = available("print/photo_paper_reflectance.csv")
    if not files:
        pytest.skip("print/photo_paper_reflectance.csv is not here")
    table = measured(files[0])
    at = table["wavelength_nm"]
    ramp = np.full((256, 3), 255)
    ramp[:, ink] = np.arange(256)
    ours = print_reflectance(ramp, on) / paper(on).white
    ours = np.stack([interpolated(at, WAVELENGTHS_NM, row) for row in ours])
    name = ("c", "m", "yellow")[ink]
    for step in ("1/4", "2/4", "3/4"):
        theirs = table[f"{name}_{step}"] / table["white"]
        away = np.sqrt(((ours - theirs) ** 2).mean(axis=1)).min()
        # Another printer's inks.
        assert away < 0.08, (name, step, away)
