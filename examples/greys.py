"""Neutrality of greys and chroma of colours that are rendered by colour under the illuminants of a LUT.

    python examples/greys.py LUT [--lights 0,35,665 | --every 50] [--picture cat.jpg ...]

The program prints for each illuminant:

- the mean and largest angle between the illuminant and 17 source greys, rendered by codes and by colour;
- the remaining chroma by colour: the slopes of ln R/G and ln B/G of the rendered colours against the target colours,
  without the black of the print. A slope of 1 means that all chroma remains;
- the share of colours that the print cannot show.

Chroma and shares are weighted by the frequency of the colours in the pictures; without pictures, all colours have the
same weight. Rendered colours are means of the samples, so the results are not random.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.table.lut import open_lut
from foundation.colorimetry import angles_deg
from generator.kernels.printing import NODES, SIDE, count_by_node
from generator.lights.choices import light_numbers
from generator.lights.lighting import single_mixture
from generator.pictures.sources import open_picture
from generator.rendering.colorimetric import ColorimetricRendering, source_colours
from generator.rendering.matrices import matrix_for

# Nodes are the source colours of a regular grid; these have equal codes of red, green and blue.
GREYS = np.arange(SIDE) * (SIDE * SIDE + SIDE + 1)

Array = npt.NDArray[np.float64]


def chroma_slopes(rendered: Array, target: Array, shares: Array) -> str:
    """Return the slopes of ln R/G and ln B/G of rendered against target colours (K, 3), weighted by `shares` (K,)."""
    slopes: list[float] = []
    for channel in (0, 2):
        x, y = (np.log(colours[:, channel] / colours[:, 1]) for colours in (target, rendered))
        x, y = x - shares @ x, y - shares @ y
        slopes.append(float((shares * x) @ y / ((shares * x) @ x)))
    return "{:.2f} {:.2f}".format(*slopes)


def row(rendering: ColorimetricRendering, light: int, shares: Array) -> list[str]:
    """Return the cells of one illuminant in the table."""
    lut, white = rendering.lut, rendering.lut.white[light]
    target, rendered = source_colours(rendering.matrix), rendering.node_means(single_mixture(light)) / white
    black = rendered[0]
    without_black = (rendered - black) / (rendered[-1] - black)
    side = 1 << lut.provenance.bits
    greys = np.arange(SIDE) * side // SIDE * (side * side + side + 1)
    printed = lut.samples[light][greys].mean(axis=1) / white
    angles = [angles_deg(colours, np.ones(3)) for colours in (printed, rendered[GREYS])]
    plan = lut.illuminations[light]
    name = "{} {} {}".format(*plan.colour) if plan.cct_k is None else f"{plan.cct_k:g} K"
    inside = shares * (target.min(axis=1) > 0.01) * (without_black.min(axis=1) > 0.01)
    return [
        f"{light}",
        name,
        *(f"{angle.mean():.2f} {angle.max():.2f}" for angle in angles),
        chroma_slopes(np.maximum(without_black, 1e-6), np.maximum(target, 1e-6), inside / inside.sum()),
        f"{shares @ rendering.map.outside:.3f}",
    ]


def main() -> int:
    """Print the table; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", type=Path)
    parser.add_argument("--lights", default="", help="illuminant numbers, as in generate --light")
    parser.add_argument("--every", type=int, default=50, help="or every N-th illuminant, from the last")
    parser.add_argument("--picture", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    lut = open_lut(options.lut)
    total = len(lut.white)
    lights = light_numbers(options.lights, total) if options.lights else range(total - 1, -1, -options.every)
    shares = np.full(NODES, 1 / NODES)
    if options.picture:
        counts = [count_by_node(open_picture(path).picture) for path in options.picture]
        shares = np.mean([count / count.sum() for count in counts], axis=0)
    matrix = matrix_for(lut)
    print(f"matrix of {matrix.name}: {matrix.source}")
    rendering = ColorimetricRendering(lut, matrix)
    head = ["light", "shown as", "greys: codes", "by colour", "chroma slopes", "outside"]
    for cells in (head, *(row(rendering, light, shares) for light in lights if isinstance(light, int))):
        print(" | ".join(f"{cell:>14}" for cell in cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
