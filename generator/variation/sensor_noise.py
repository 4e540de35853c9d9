"""Noise of the samples of a look-up table (LUT), and of the same camera at a higher ISO speed.

The model is photon transfer (EMVA 1288, release 4.0, section 2.4). A sample with a mean of y counts has the variance

    read² + shot · y,        shot = 1 / (electrons per count)

Differences between photosites and within the print add a term in y². The model leaves it out, because it is scaled
together with the sample. read and shot are measured from means and variances of the samples of dark and bright patches.

At k times the ISO speed of the LUT, a count stands for k times fewer electrons, so shot becomes k · shot. Read noise
that arises before the amplifier grows with k, read noise after it does not. A LUT of one speed shows only their sum.
Therefore the part before the amplifier is assumed to be `SENSOR_ELECTRONS`, unless a value is given.

Normal deviates come from a table of 2¹⁴ numbers: the quantiles of the standard normal distribution at (i + ½) / 2¹⁴,
scaled to variance 1. Their mean is exactly 0. They reach 4.0 standard deviations; 6 of 100 000 normal numbers lie
beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from calibration.table.lut import Lut


BITS: Final = 14  # Bits of a random word that select a deviate: the table of 64 KiB fits into the second-level cache


@lru_cache(maxsize=1)
def normal_deviates() -> npt.NDArray[np.float32]:
    """Return the table of deviates, (16384,) float32, in ascending order."""
    half = 1 << (BITS - 1)
    upper = np.array([NormalDist().inv_cdf(0.5 + (index + 0.5) / (2 * half)) for index in range(half)])
    upper /= np.sqrt(np.mean(upper**2))
    return np.concatenate([-upper[::-1], upper]).astype(np.float32)


Three = tuple[float, float, float]

# Read noise of a photosite that arises before the amplifier, electrons. Chosen by judgement: sensors of 2008 to 2020
# have about 2 to 3 at their highest speeds, where other read noise is negligible (W. Claff, photonstophotos.net,
# input-referred read noise).
SENSOR_ELECTRONS: Final = 2.5

# Photosites averaged for red, green and blue of a sample, a half-size pixel of a Bayer mosaic.
_PHOTOSITES: Final = (1, 2, 1)


@dataclass(frozen=True)
class SensorNoise:
    """Noise of red, green and blue samples: variance = read² + shot · mean.

    - `read`: read noise, counts, ≥ 0.
    - `shot`: variance per count of the mean, counts, ≥ 0.

    Examples
    --------
    >>> noise = SensorNoise(read=(6.0, 4.2, 6.0), shot=(0.56, 0.28, 0.56))
    >>> noise.at(4.0).shot
    (2.24, 1.12, 2.24)
    """

    read: Three
    shot: Three

    def at(self, ratio: float, sensor_electrons: float = SENSOR_ELECTRONS) -> SensorNoise:
        """Return the noise at `ratio` ≥ 1 times the ISO speed, for samples of the same mean."""
        read: list[float] = []
        for counts, shot, photosites in zip(self.read, self.shot, _PHOTOSITES, strict=True):
            before_amplifier = min(counts**2, photosites * (sensor_electrons * shot) ** 2)
            read.append(float(np.sqrt(counts**2 + (ratio**2 - 1) * before_amplifier)))
        return SensorNoise(_three(read), _three([ratio * shot for shot in self.shot]))

    def describe(self) -> dict[str, Any]:
        """Return the values as plain lists."""
        return {"read": list(self.read), "shot": list(self.shot)}


def measured_noise(lut: Lut) -> SensorNoise:
    """Return the noise of the samples of a LUT; raises InputError like `noise_curve`.

    Values are rounded to six digits, so that they are equal on all machines.
    """
    # Imported here because it loads scipy and cv2, which the generation of images does not need.
    from calibration.radiometry.table_noise import noise_curve

    curve = noise_curve(lut)
    if curve is None:
        return SensorNoise((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    shot = [0.0 if not np.isfinite(gain) else 1 / gain for gain in curve.gain_e.tolist()]
    return SensorNoise(_three(curve.read_noise.tolist()), _three(shot))


def _three(numbers: list[float]) -> Three:
    red, green, blue = (float(f"{number:.6g}") for number in numbers)
    return red, green, blue
