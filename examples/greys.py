"""How grey a source's greys are under the lights of a table, and how much chroma is kept, when rendered by colour.

    python examples/greys.py LUT [--lights 0,35,665 | --every 50] [--picture cat.jpg ...]

For each light: the angle between the light and the source's 17 greys, in the mean and the worst, as the chart shows
their codes and by colour; the share of chroma that is kept by colour, as slopes of ln R/G and ln B/G of what is seen,
without the print's black, against what is wanted; and the share of colours that the print cannot show. Chroma and
shares are those of the pictures' colours, or of all source colours alike if none is given. What is seen is the mean of
the table's own samples, so nothing here is random.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.table.lut import open_lut
from foundation.colorimetry import angles_deg
from generator.kernels.printing import NODES, SIDE, nearest_nodes
from generator.lights.choices import light_numbers
from generator.lights.lighting import plain
from generator.pictures.sources import open_picture
from generator.rendering.colorimetric import ColorimetricRendering, source_colours
from generator.rendering.matrices import matrix_for

# Nodes of equal codes of red, green and blue.
GREYS = np.arange(SIDE) * (SIDE * SIDE + SIDE + 1)

Array = npt.NDArray[np.float64]


def kept(seen: Array, wanted: Array, shares: Array) -> str:
    """Return the slopes of ln R/G and ln B/G of (K, 3) float64 seen against wanted, by (K,) shares of sum 1."""
    slopes: list[float] = []
    for channel in (0, 2):
        x, y = (np.log(colours[:, channel] / colours[:, 1]) for colours in (wanted, seen))
        x, y = x - shares @ x, y - shares @ y
        slopes.append(float((shares * x) @ y / ((shares * x) @ x)))
    return "{:.2f} {:.2f}".format(*slopes)


def row(rendering: ColorimetricRendering, light: int, shares: Array) -> list[str]:
    """Return the figures of one light."""
    lut, white = rendering.lut, rendering.lut.white[light]
    wanted, seen = source_colours(rendering.matrix), rendering.seen(plain(light)) / white
    black = seen[0]
    bare = (seen - black) / (seen[-1] - black)
    side = 1 << lut.provenance.bits
    greys = np.arange(SIDE) * side // SIDE * (side * side + side + 1)
    printed = lut.samples[light][greys].mean(axis=1) / white
    angles = [angles_deg(colours, np.ones(3)) for colours in (printed, seen[GREYS])]
    plan = lut.illuminations[light]
    name = "{} {} {}".format(*plan.colour) if plan.cct_k is None else f"{plan.cct_k:g} K"
    inside = shares * (wanted.min(axis=1) > 0.01) * (bare.min(axis=1) > 0.01)
    return [
        f"{light}",
        name,
        *(f"{angle.mean():.2f} {angle.max():.2f}" for angle in angles),
        kept(np.maximum(bare, 1e-6), np.maximum(wanted, 1e-6), inside / inside.sum()),
        f"{shares @ rendering.map.outside:.3f}",
    ]


def main() -> int:
    """Print the table; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", type=Path)
    parser.add_argument("--lights", default="", help="numbers, as in generate --light")
    parser.add_argument("--every", type=int, default=50, help="or each so-maniest light, from the last")
    parser.add_argument("--picture", type=Path, nargs="*", default=[])
    given = parser.parse_args()
    lut = open_lut(given.lut)
    total = len(lut.white)
    lights = light_numbers(given.lights, total) if given.lights else range(total - 1, -1, -given.every)
    shares = np.full(NODES, 1 / NODES)
    if given.picture:
        counts = [nearest_nodes(open_picture(path).picture) for path in given.picture]
        shares = np.mean([count / count.sum() for count in counts], axis=0)
    matrix = matrix_for(lut)
    print(f"matrix of {matrix.name}: {matrix.source}")
    rendering = ColorimetricRendering(lut, matrix)
    head = ["light", "shown as", "greys: codes", "by colour", "chroma kept", "outside"]
    for cells in (head, *(row(rendering, light, shares) for light in lights if isinstance(light, int))):
        print(" | ".join(f"{cell:>14}" for cell in cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
