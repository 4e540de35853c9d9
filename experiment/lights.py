"""The lights of an experiment, as many as the paper's 707, their file `illuminations.csv`, and the figure of them.

The paper (section 3.1) asks for chromaticities spread uniformly and for black bodies but gives no recipe. Ours: the
points of a triangular grid r = i/n, b = j/n, g = 1 − r − b in linear light, and black bodies from 2000 K to 10 000 K;
each scaled to its brightest channel and encoded with the projector's transfer function (sRGB unless measured).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from drivers.presenter import Colour
from foundation.colorimetry import decode_srgb, encode_srgb, linear_srgb, planck, xyz_of
from foundation.errors import FormatError, InputError
from foundation.files import atomic_file, csv_text, read_csv, write_atomic

Kind = Literal["uniform", "blackbody", "spectrum"]
COLUMNS = ("index", "kind", "cct_k", "red", "green", "blue")  # Columns of `illuminations.csv` (docs/formats.md)

NAME = "name"  # A further column where lights have names: those of computed tables under spectra of their own

# Steps along an edge of the chromaticity triangle: 666 points, which with 41 black bodies are the paper's 707.
GRID = 35

CCTS_K = tuple(range(2000, 10001, 200))  # Black bodies of the plan, kelvin: from candle light to blue sky

MOST_CCTS = 10_000  # Most temperatures that a text may name: more are a mistake in the step


FORMATS = ("png", "pdf", "svg")  # Endings of a figure's file name, and Matplotlib's names of these formats

# Temperatures that the figure names, kelvin: few enough for their names not to touch.
_NAMED_CCTS_K = (2000, 3000, 4000, 6000, 10000)


@dataclass(frozen=True)
class Illumination:
    """One light of the plan: its number, its kind, its temperature if a black body, and the codes shown.

    Where light has a spectrum of its own (`kind` ``spectrum``, or a black body that was computed and not shown by a
    projector), the codes are those that would show its colour, and it has a `name`, such as ``D65``.
    """

    index: int
    kind: Kind
    cct_k: float | None
    colour: Colour
    name: str | None = None


def shown_colour(linear: npt.ArrayLike) -> Colour:
    """Return the codes that show a linear RGB light (3,) float ≥ 0 at the brightest that its chromaticity allows."""
    linear = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    codes = np.rint(255 * encode_srgb(linear / linear.max())).astype(int)
    return Colour(*(int(code) for code in codes))


def uniform_lights(grid: int = GRID) -> list[npt.NDArray[np.float64]]:
    """Return the (grid+1)(grid+2)/2 points of the triangular grid as linear (r, g, b), (3,) float64 of sum 1."""
    return [
        np.array([i, grid - i - j, j], dtype=np.float64) / grid for i in range(grid + 1) for j in range(grid + 1 - i)
    ]


def blackbody_light(cct_k: float) -> npt.NDArray[np.float64]:
    """Return the linear sRGB of a black body, (3,) float64, its brightest channel 1.

    Planck's law at `cct_k` kelvin, CIE 1931 2° observer, sRGB primaries (IEC 61966-2-1); what lies outside the
    gamut is clipped to it.
    """
    wavelengths = np.arange(360.0, 781.0)
    linear = np.maximum(linear_srgb(xyz_of(wavelengths, planck(wavelengths, cct_k))), 0.0)
    return linear / linear.max()


def plan_illuminations(grid: int = GRID, ccts_k: Sequence[float] = CCTS_K) -> tuple[Illumination, ...]:
    """Return the lights of an experiment: the triangular grid first, then the black bodies."""
    lights: list[Illumination] = []
    for linear in uniform_lights(grid) if grid else ():
        lights.append(Illumination(len(lights), "uniform", None, shown_colour(linear)))
    for cct_k in ccts_k:
        lights.append(Illumination(len(lights), "blackbody", float(cct_k), shown_colour(blackbody_light(cct_k))))
    return tuple(lights)


def illuminations_to_csv(illuminations: Sequence[Illumination]) -> str:
    """Return the text of `illuminations.csv`."""
    rows: list[Sequence[object]] = [COLUMNS]
    for light in illuminations:
        # Whole kelvin without a point, anything else with all its digits.
        cct = "" if light.cct_k is None else repr(light.cct_k).removesuffix(".0")
        rows.append([light.index, light.kind, cct, *light.colour])
    return csv_text(rows)


def save_illuminations(illuminations: Sequence[Illumination], path: Path) -> None:
    """Write `illuminations.csv`."""
    write_atomic(path, illuminations_to_csv(illuminations))


def load_illuminations(path: Path, *, computed: bool = False) -> tuple[Illumination, ...]:
    """Read `illuminations.csv`; further columns are ignored."""
    rows = read_csv(path, "make one with: acquire illuminations", "illuminations")[1]
    if not rows or any(column not in rows[0] for column in COLUMNS):
        raise FormatError(f"{path}: expected lights under the columns {','.join(COLUMNS)}")
    lights: list[Illumination] = []
    for number, row in enumerate(rows):
        kind, kelvin = row["kind"], row["cct_k"]
        cct_k: float | None = None
        try:
            if kind not in ("uniform", "blackbody", "spectrum") or (kind == "spectrum" and not computed):
                raise ValueError(f"kind is {kind!r}, expected uniform or blackbody")
            for column in ("index", "red", "green", "blue"):
                if not row[column].strip().removeprefix("-").isdecimal():
                    raise ValueError(f"{column} is {row[column] or 'missing'}, expected a whole number")
            if int(row["index"]) != number:
                raise ValueError(f"index is {row['index']}, expected {number}")
            if kind == "blackbody":
                with suppress(ValueError):
                    cct_k = float(kelvin)
                if cct_k is None or not 0 < cct_k < math.inf:
                    raise ValueError(f"cct_k is {kelvin or 'missing'}, expected kelvin above 0")
            colour = Colour(int(row["red"]), int(row["green"]), int(row["blue"]))
            for name, code in zip(Colour._fields, colour, strict=True):
                if not 0 <= code <= 255:
                    raise ValueError(f"{name} is {code}; a code is 0 … 255")
        except ValueError as error:
            raise FormatError(f"{path}, light {number}: {error}") from error
        lights.append(Illumination(number, kind, cct_k, colour, (row.get(NAME) or None) if computed else None))
    return tuple(lights)


def parse_ccts(text: str) -> tuple[float, ...]:
    """Return the temperatures in ``FIRST:LAST:STEP`` or ``K,K,…``, kelvin; empty text gives none."""
    given = f"black bodies {text!r}"
    try:
        named = [float(part) for part in text.split(":" if ":" in text else ",") if part.strip()]
    except ValueError as error:
        raise InputError(f"{given}: expected FIRST:LAST:STEP or K,K,… in kelvin") from error
    if ":" in text:
        if len(named) != 3:
            raise InputError(f"{given}: expected FIRST:LAST:STEP or K,K,… in kelvin")
        first, last, step = named
        _require_kelvin((first, last), given)
        steps = (last - first) / step if step else math.nan
        if not 0 <= steps < MOST_CCTS:
            raise InputError(
                f"{given}: steps of {step:g} K do not lead from {first:g} to {last:g} K in at most {MOST_CCTS} "
                "temperatures; a falling range has a step below 0"
            )
        return tuple(first + step * number for number in range(int(steps + 1e-9) + 1))
    _require_kelvin(named, given)
    return tuple(named)


def _require_kelvin(ccts: Sequence[float], given: str) -> None:
    for cct_k in ccts:
        if not 1000 <= cct_k <= 100_000:
            raise InputError(f"{given}: {cct_k:g} K is not within 1000 … 100 000 K")


def plot_illuminations(illuminations: Sequence[Illumination], path: Path) -> None:
    """Plot the rb-chromaticities of lights (paper, section 3.1), each point in the colour of its light.

    Chromaticities are those of the linear light that a projector with the sRGB transfer function sends out:
    r = R / (R + G + B) and b = B / (R + G + B) of the decoded codes. A light without any light is left out.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ending = path.suffix.lower().removeprefix(".")
    if ending not in FORMATS:
        raise InputError(f"a figure cannot be written as {path.name}; end its name with .{', .'.join(FORMATS)}")
    lit = [light for light in illuminations if any(light.colour)]
    codes = np.array([light.colour for light in lit]).reshape(-1, 3) / 255
    linear = decode_srgb(codes)
    r, _, b = (linear / linear.sum(axis=1, keepdims=True)).T
    black_body = np.array([light.kind == "blackbody" for light in lit], dtype=np.bool_)

    # Matplotlib's own types leave the keyword arguments of every method unknown.
    figure: Any = Figure(figsize=(7.2, 6.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot([0, 1, 0, 0], [0, 0, 1, 0], color="0.75", linewidth=0.8, zorder=1)
    axes.scatter(
        r[~black_body],
        b[~black_body],
        s=22,
        c=codes[~black_body],
        edgecolors="0.55",
        linewidths=0.3,
        zorder=2,
        label=f"uniform ({int((~black_body).sum())})",
    )
    axes.scatter(
        r[black_body],
        b[black_body],
        s=34,
        c=codes[black_body],
        marker="D",
        edgecolors="black",
        linewidths=0.9,
        zorder=3,
        label=f"black bodies ({int(black_body.sum())})",
    )
    for light, x, y in zip(lit, r, b, strict=True):
        if light.cct_k in _NAMED_CCTS_K:
            # Named outside the triangle, so that no light is hidden.
            away = (1.04 - float(x) - float(y)) / 2
            axes.annotate(
                f"{light.cct_k:g} K",
                (float(x), float(y)),
                xytext=(float(x) + away, float(y) + away),
                fontsize=9,
                arrowprops={"arrowstyle": "-", "color": "0.3", "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4},
                zorder=4,
            )
    axes.set_xlabel("r")
    axes.set_ylabel("b")
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    axes.set_aspect("equal")
    axes.legend(loc="upper right", frameon=False)
    axes.set_title(f"rb-chromaticities of {len(lit)} illuminations")
    # The day of writing is kept out of the file, so that the same lights give the same PNG.
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}[ending]
    with atomic_file(path) as stream:
        figure.savefig(stream, format=ending, dpi=150, metadata=metadata)
