"""Greys rendered by colour: `python -m benchmarks.greys LUT ...` prints one JSON object per line for each LUT.

Under each illuminant of a LUT, each of the 256 greys is rendered by colour 4096 times. The results are:

- the angle between the mean of a grey and the illuminant;
- the noise of a grey, relative to the photon-transfer curve of the LUT;
- the smallest rise from one grey code to the next, divided by its standard error;
- the share of codes at which the slope of the brightness over codes changes by more than three standard errors (bends);
- the share of the 4913 source colours that the print cannot show.

The benchmark takes a few seconds per LUT.
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
from generator.lights.lighting import single_mixture
from generator.rendering.colorimetric import rendering_with
from generator.rendering.matrices import matrix_for

REPEATS = 4096
# Greys of which the noise is measured: the noise of darker and brighter greys may be clipped.
NOISE = slice(20, 231)
# First code of which the bend is measured: the slope of brightness over dark codes changes by itself. If all black is
# subtracted, this is also the first code for angle and rise.
BRIGHT_FROM = 64


def measure(lut: Lut, name: str, black_share: float) -> None:
    """Print the figures of one LUT."""
    curve = noise_curve(lut)
    if curve is None:
        raise InputError(f"{lut.folder} records no noise, which this benchmark needs; name another LUT")
    rendering = rendering_with(lut, matrix_for(lut))
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2).repeat(REPEATS, axis=1)
    first = BRIGHT_FROM if black_share else 0
    angles: list[float] = []
    ratios: list[npt.NDArray[np.float64]] = []
    smallest_rise, bends = np.inf, 0.0
    for light in range(len(lut.samples)):
        mixture = single_mixture(light)
        image = rendering.draw(ramp, [mixture], black_share).astype(np.float64)
        means, spreads = image.mean(axis=1), image.std(axis=1)
        # If all black is subtracted, the darkest greys have no colour.
        angles.append(float(angles_deg(means[first:], mixture.white(lut)).max()))
        if not black_share:
            variance = curve.read_noise**2 + means / curve.gain_e + (curve.response * means) ** 2
            ratios.append((spreads / np.sqrt(variance))[NOISE])
        errors = spreads / np.sqrt(REPEATS)
        rises = np.diff(means, axis=0) / np.maximum(np.hypot(errors[1:], errors[:-1]), 1e-9)
        smallest_rise = min(smallest_rise, float(rises[first:-1].min()))
        brightness = means.sum(axis=1)
        error = np.sqrt((errors**2).sum(axis=1))[BRIGHT_FROM:-2] * np.sqrt(6)
        bends = max(bends, float((np.abs(np.diff(brightness, 2)[BRIGHT_FROM:] / error) > 3).mean()))
    scope = f"{len(lut.samples)} illuminants of {name}" + (", all black subtracted" if black_share else "")
    report("greys, largest angle to the illuminant", max(angles), "degrees", scope)
    if ratios:
        every_ratio = np.concatenate(ratios)
        for label, value in (("mean", every_ratio.mean()), ("least", every_ratio.min()), ("most", every_ratio.max())):
            report(f"noise of greys 20 to 230, {label}", float(value), "ratio", f"photon transfer, {scope}")
        report("source colours that the print cannot show", float(rendering.map.outside.mean()), "share", name)
    report("smallest rise between neighbouring greys", smallest_rise, "standard errors", scope)
    report("bends beyond three standard errors, worst illuminant", bends, "share", scope)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("luts", nargs="+", type=Path, help="folders of LUTs; demo: is a small LUT")
    for folder in parser.parse_args(arguments).luts:
        for black_share in (0.0, 1.0):
            measure(open_lut(table_folder(folder)), folder.name, black_share)


if __name__ == "__main__":
    main()
