"""Greys by colour: `python -m benchmarks.greys LUT ...` prints one JSON object a line for each table.

Under each light of a table all 256 greys are rendered by colour, each 4096 times. Printed are how far their means are
off the light, what their noise is in parts of what the table's photon-transfer curve says of that level, and how even
the ramp is: the least rise from one code to the next, over the standard error of that difference; and how many of all
4913 source colours the print cannot show. Takes a few seconds a table.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.generator import report
from calibration.radiometry.table_noise import noise_curve
from calibration.table.demo_table import table_folder
from calibration.table.lut import Lut, open_lut
from foundation.colorimetry import angles_deg
from foundation.errors import InputError
from generator.lights.lighting import plain
from generator.rendering.colorimetric import rendering_with
from generator.rendering.matrices import matrix_for

REPEATS = 4096
# Codes of the greys whose noise counts: noise of darker and brighter ones may be cut off.
NOISE = slice(20, 231)
# Code from which bends of a ramp are counted, since light rises evenly in light, not in codes; and from which greys
# count where all black is taken out.
BRIGHT_FROM = 64


def measure(lut: Lut, name: str, black_taken: float) -> None:
    """Print the figures of a table."""
    curve = noise_curve(lut)
    if curve is None:
        raise InputError(f"{lut.folder} does not know its noise; name another table")
    rendering = rendering_with(lut, matrix_for(lut))
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2).repeat(REPEATS, axis=1)
    first = BRIGHT_FROM if black_taken else 0
    offs: list[float] = []
    ratios: list[npt.NDArray[np.float64]] = []
    least, bends = np.inf, 0.0
    for light in range(len(lut.samples)):
        mixture = plain(light)
        image = rendering.draw(ramp, [mixture], black_taken).astype(np.float64)
        means, spreads = image.mean(axis=1), image.std(axis=1)
        # Black that is taken out wholly has no colour.
        offs.append(float(angles_deg(means[first:], mixture.white(lut)).max()))
        if not black_taken:
            variance = curve.read_noise**2 + means / curve.gain_e + (curve.response * means) ** 2
            ratios.append((spreads / np.sqrt(variance))[NOISE])
        errors = spreads / np.sqrt(REPEATS)
        rises = np.diff(means, axis=0) / np.maximum(np.hypot(errors[1:], errors[:-1]), 1e-9)
        least = min(least, float(rises[first:-1].min()))
        brightness = means.sum(axis=1)
        error = np.sqrt((errors**2).sum(axis=1))[BRIGHT_FROM:-2] * np.sqrt(6)
        bends = max(bends, float((np.abs(np.diff(brightness, 2)[BRIGHT_FROM:] / error) > 3).mean()))
    what = f"{len(lut.samples)} lights of {name}" + (", all black taken out" if black_taken else "")
    report("greys off the light, worst", max(offs), "degrees", what)
    if ratios:
        every = np.concatenate(ratios)
        for word, value in (("mean", every.mean()), ("least", every.min()), ("most", every.max())):
            report(f"noise of greys 20 to 230, {word}", float(value), "ratio", f"photon transfer, {what}")
        report("source colours that the print cannot show", float(rendering.map.outside.mean()), "share", name)
    report("least rise from a grey to the next", least, "standard errors", what)
    report("bends beyond three standard errors, most of a light", bends, "share", what)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("luts", nargs="+", type=Path, help="folders of tables; demo: for a small one")
    for folder in parser.parse_args(arguments).luts:
        for black_taken in (0.0, 1.0):
            measure(open_lut(table_folder(folder)), folder.name, black_taken)


if __name__ == "__main__":
    main()
