"""How grey a source's greys are under the lights of a table, and how much chroma is kept, when rendered by colour.

    python examples/greys.py LUT [--lights 0,35,665 | --every 50] [--picture cat.jpg ...]

For each light: the angle between the light and the source's 32 greys, in the mean and the worst, as the chart shows
their codes, by a map made under 5600 K, and by that of the light itself; the share of chroma kept by the latter two, as
slopes of ln R/G and ln B/G of what is seen against what is wanted; and the share of colours that the print cannot show.
Chroma and shares are those of the pictures' colours, or of all source colours alike if none is given. What is seen is
the mean of the table's own samples, so nothing here is random.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.table.lut import Lut, open_lut
from foundation.colorimetry import angles_deg
from generator.kernels.dithering import nearest_nodes
from generator.lights.choices import parse_lights
from generator.pictures.picture import open_picture
from generator.rendering.colorimetric import NODES, colorimetric_mixtures
from generator.rendering.matrices import ColourMatrix, matrix_for
from generator.rendering.print_profiles import profile_of

GREYS = np.arange(32) * (32 * 32 + 32 + 1)
"""Source nodes of equal codes of red, green and blue."""

MAP_K = 5600.0
"""Light of the map that serves all lights."""

Array = npt.NDArray[np.float64]


def kept(seen: Array, wanted: Array, shares: Array) -> str:
    """Return the slopes of ln R/G and ln B/G of (K, 3) float64 seen against wanted, by (K,) shares of sum 1."""
    slopes: list[float] = []
    for channel in (0, 2):
        x, y = (np.log(colours[:, channel] / colours[:, 1]) for colours in (wanted, seen))
        x, y = x - shares @ x, y - shares @ y
        slopes.append(float((shares * x) @ y / ((shares * x) @ x)))
    return "{:.2f} {:.2f}".format(*slopes)


def row(lut: Lut, light: int, matrix: ColourMatrix, shares: Array) -> list[str]:
    """Return the figures of one light."""
    profile, own = profile_of(lut, light), colorimetric_mixtures(lut, light, matrix)
    wanted = own.wanted.astype(np.float64)
    maps = [colorimetric_mixtures(lut, MAP_K, matrix), own]
    seen = [profile.colours[mixtures.cells].mean(axis=1) for mixtures in maps]
    side = 1 << lut.provenance.bits
    printed = profile.colours[np.arange(32) * side // 32 * (side * side + side + 1)]
    angles = [angles_deg(greys, np.ones(3)) for greys in (printed, *(colours[GREYS] for colours in seen))]
    plan = lut.illuminations[light]
    name = "{} {} {}".format(*plan.codes) if plan.cct_k is None else f"{plan.cct_k:g} K"
    return [
        f"{light}",
        name,
        *(f"{angle.mean():.2f} {angle.max():.2f}" for angle in angles),
        *(kept(colours, wanted, shares) for colours in seen),
        f"{shares @ own.outside:.3f}",
    ]


def main() -> int:
    """Print the table; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", type=Path)
    parser.add_argument("--lights", default="", help="numbers, as in generate --illuminations")
    parser.add_argument("--every", type=int, default=50, help="or each so-maniest light, from the last")
    parser.add_argument("--picture", type=Path, nargs="*", default=[])
    given = parser.parse_args()
    lut = open_lut(given.lut)
    total = len(lut.white)
    lights = parse_lights(given.lights, total).lights if given.lights else range(total - 1, -1, -given.every)
    shares = np.full(NODES, 1 / NODES)
    if given.picture:
        counts = [nearest_nodes(open_picture(path).picture) for path in given.picture]
        shares = np.mean([count / count.sum() for count in counts], axis=0)
    matrix = matrix_for(lut)
    print(f"matrix of {matrix.name}: {matrix.source}")
    head = ["light", "shown as", "greys: codes", "by 5600 K", "by its own", "chroma: 5600 K", "its own", "outside"]
    for cells in (head, *(row(lut, light, matrix, shares) for light in lights if isinstance(light, int))):
        print(" | ".join(f"{cell:>14}" for cell in cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
