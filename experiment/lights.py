"""Plan the illuminants of an experiment, read and write `illuminations.csv`, and plot the illuminants.

The paper (Banić et al. 2019, section 3.1) uses 707 illuminants: uniformly spread chromaticities and black bodies. It
does not list them. Here the uniform chromaticities form a triangular grid in linear light: r = i/n, b = j/n,
g = 1 − r − b. The black bodies have 2000 K to 10 000 K. Every illuminant is scaled until its brightest channel is 1,
and encoded with the sRGB transfer function.
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

NAME = "name"  # Additional column with names of illuminants, for LUTs that are computed from spectra

# Steps along an edge of the chromaticity triangle. These 666 points and 41 black bodies are the 707 illuminants of the
# paper.
GRID = 35

CCTS_K = tuple(range(2000, 10001, 200))  # Black bodies of the plan, K: from candle light to blue sky

MOST_CCTS = 10_000  # Largest number of temperatures in a range; more are probably a typing error in the step


FORMATS = ("png", "pdf", "svg")  # File extensions of plots, and Matplotlib's names of the formats

# Temperatures with a label in the plot, K. More labels would overlap.
_NAMED_CCTS_K = (2000, 3000, 4000, 6000, 10000)


@dataclass(frozen=True)
class Illuminant:
    """One illuminant of the plan."""

    index: int
    kind: Kind  # "spectrum": an illuminant of a LUT that was computed from spectra
    cct_k: float | None  # temperature of a black body, K
    colour: Colour  # codes that the projector shows; for kind "spectrum", codes of the nearest colour
    name: str | None = None  # name of an illuminant of kind "spectrum", such as "D65"


def shown_colour(linear: npt.ArrayLike) -> Colour:
    """Return the codes of a linear RGB colour (3,) float ≥ 0, scaled until its brightest channel is 255."""
    linear = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    codes = np.rint(255 * encode_srgb(linear / linear.max())).astype(int)
    return Colour(*(int(code) for code in codes))


def uniform_lights(grid: int = GRID) -> list[npt.NDArray[np.float64]]:
    """Return the (grid+1)(grid+2)/2 points of the triangular grid: linear r, g, b, (3,) float64 with the sum 1."""
    return [
        np.array([i, grid - i - j, j], dtype=np.float64) / grid for i in range(grid + 1) for j in range(grid + 1 - i)
    ]


def blackbody_light(cct_k: float) -> npt.NDArray[np.float64]:
    """Return the linear sRGB (3,) float64 of a black body with the temperature `cct_k`; the brightest channel is 1.

    Planck's law, CIE 1931 2° observer and sRGB primaries (IEC 61966-2-1). Negative channels become 0.
    """
    wavelengths = np.arange(360.0, 781.0)
    linear = np.maximum(linear_srgb(xyz_of(wavelengths, planck(wavelengths, cct_k))), 0.0)
    return linear / linear.max()


def plan_illuminants(grid: int = GRID, ccts_k: Sequence[float] = CCTS_K) -> tuple[Illuminant, ...]:
    """Return the illuminants of an experiment: the triangular grid first, then the black bodies."""
    lights: list[Illuminant] = []
    for linear in uniform_lights(grid) if grid else ():
        lights.append(Illuminant(len(lights), "uniform", None, shown_colour(linear)))
    for cct_k in ccts_k:
        lights.append(Illuminant(len(lights), "blackbody", float(cct_k), shown_colour(blackbody_light(cct_k))))
    return tuple(lights)


def illuminants_to_csv(illuminations: Sequence[Illuminant]) -> str:
    """Return the text of `illuminations.csv`."""
    rows: list[Sequence[object]] = [COLUMNS]
    for light in illuminations:
        # Whole numbers are written without ".0", other numbers with all digits.
        cct = "" if light.cct_k is None else repr(light.cct_k).removesuffix(".0")
        rows.append([light.index, light.kind, cct, *light.colour])
    return csv_text(rows)


def save_illuminants(illuminations: Sequence[Illuminant], path: Path) -> None:
    """Write `illuminations.csv`."""
    write_atomic(path, illuminants_to_csv(illuminations))


def load_illuminants(path: Path, *, computed: bool = False) -> tuple[Illuminant, ...]:
    """Read `illuminations.csv`; additional columns are ignored.

    `computed`: whether the file belongs to a LUT computed from spectra, whose illuminants have names.
    """
    rows = read_csv(path, "make one with: acquire illuminations", "illuminations")[1]
    if not rows or any(column not in rows[0] for column in COLUMNS):
        raise FormatError(f"{path} has no illuminants, expected columns {','.join(COLUMNS)}; run acquire illuminations")
    lights: list[Illuminant] = []
    for number, row in enumerate(rows):
        kind, kelvin = row["kind"], row["cct_k"]
        cct_k: float | None = None
        try:
            if kind not in ("uniform", "blackbody", "spectrum") or (kind == "spectrum" and not computed):
                raise ValueError(f"kind is {kind!r}, expected uniform{', spectrum' if computed else ''} or blackbody")
            for column in ("index", "red", "green", "blue"):
                if not row[column].strip().removeprefix("-").isdecimal():
                    raise ValueError(f"{column} is {row[column] or 'missing'}, expected a whole number")
            if int(row["index"]) != number:
                raise ValueError(f"index is {row['index']}, expected {number}")
            if kind == "blackbody":
                with suppress(ValueError):
                    cct_k = float(kelvin)
                if cct_k is None or not 0 < cct_k < math.inf:
                    raise ValueError(f"cct_k is {kelvin or 'missing'}, expected a temperature above 0 K")
            colour = Colour(int(row["red"]), int(row["green"]), int(row["blue"]))
            for name, code in zip(Colour._fields, colour, strict=True):
                if not 0 <= code <= 255:
                    raise ValueError(f"{name} is {code}, expected a code from 0 to 255")
        except ValueError as error:
            raise FormatError(f"{path}, illuminant {number}: {error}; correct this row") from error
        lights.append(Illuminant(number, kind, cct_k, colour, (row.get(NAME) or None) if computed else None))
    return tuple(lights)


def parse_ccts(text: str) -> tuple[float, ...]:
    """Parse temperatures in K, written as ``FIRST:LAST:STEP`` or ``K,K,…``; an empty text gives no temperature."""
    description = f"black bodies {text!r}"
    try:
        ccts = [float(field) for field in text.split(":" if ":" in text else ",") if field.strip()]
    except ValueError as error:
        raise InputError(f"{description}, expected FIRST:LAST:STEP or K,K,… in kelvin; correct them") from error
    if ":" in text:
        if len(ccts) != 3:
            raise InputError(f"{description}, expected FIRST:LAST:STEP or K,K,… in kelvin; correct them")
        first, last, step = ccts
        _require_kelvin((first, last), description)
        steps = (last - first) / step if step else math.nan
        if not 0 <= steps < MOST_CCTS:
            raise InputError(
                f"{description}: a range from {first:g} to {last:g} K in steps of {step:g} K, expected at most "
                f"{MOST_CCTS} temperatures, and a negative step if the range falls; change the step"
            )
        return tuple(first + step * number for number in range(int(steps + 1e-9) + 1))
    _require_kelvin(ccts, description)
    return tuple(ccts)


def _require_kelvin(ccts: Sequence[float], description: str) -> None:
    for cct_k in ccts:
        if not 1000 <= cct_k <= 100_000:
            raise InputError(f"{description}: {cct_k:g} K is given, expected 1000 to 100 000 K; correct it")


def plot_illuminants(illuminations: Sequence[Illuminant], path: Path) -> None:
    """Plot the rb-chromaticities of illuminants, each point in its colour (as in the paper, section 3.1).

    Chromaticities r = R / (R + G + B) and b = B / (R + G + B) are computed from the codes, decoded to linear light
    with the sRGB transfer function. An illuminant with the codes 0, 0, 0 is omitted.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ending = path.suffix.lower().removeprefix(".")
    if ending not in FORMATS:
        raise InputError(f"the plot is {path.name}, expected a name that ends in .{', .'.join(FORMATS)}; rename it")
    lit_lights = [light for light in illuminations if any(light.colour)]
    codes = np.array([light.colour for light in lit_lights]).reshape(-1, 3) / 255
    linear = decode_srgb(codes)
    r, _, b = (linear / linear.sum(axis=1, keepdims=True)).T
    is_black_body = np.array([light.kind == "blackbody" for light in lit_lights], dtype=np.bool_)

    # Matplotlib's type annotations lack the keyword arguments.
    figure: Any = Figure(figsize=(7.2, 6.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot([0, 1, 0, 0], [0, 0, 1, 0], color="0.75", linewidth=0.8, zorder=1)
    axes.scatter(
        r[~is_black_body],
        b[~is_black_body],
        s=22,
        c=codes[~is_black_body],
        edgecolors="0.55",
        linewidths=0.3,
        zorder=2,
        label=f"uniform ({int((~is_black_body).sum())})",
    )
    axes.scatter(
        r[is_black_body],
        b[is_black_body],
        s=34,
        c=codes[is_black_body],
        marker="D",
        edgecolors="black",
        linewidths=0.9,
        zorder=3,
        label=f"black bodies ({int(is_black_body.sum())})",
    )
    for light, x, y in zip(lit_lights, r, b, strict=True):
        if light.cct_k in _NAMED_CCTS_K:
            # Place the labels outside the triangle, so that they hide no point.
            shift = (1.04 - float(x) - float(y)) / 2
            axes.annotate(
                f"{light.cct_k:g} K",
                (float(x), float(y)),
                xytext=(float(x) + shift, float(y) + shift),
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
    axes.set_title(f"rb-chromaticities of {len(lit_lights)} illuminants")
    # Without date and software name, the same illuminants give the same file.
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}[ending]
    with atomic_file(path) as stream:
        figure.savefig(stream, format=ending, dpi=150, metadata=metadata)
