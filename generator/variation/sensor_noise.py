"""The noise of a table's samples, and that of the same camera at a higher ISO speed.

The model is photon transfer (EMVA 1288, release 4.0, section 2.4): a sample of the mean y counts has the variance

    read² + shot · y,        shot = 1 / (electrons per count)

beside what grows with y² (photosites and print that differ), which scales with a sample and is left in it. A table's
numbers are measured from its samples: cells of all levels, each with the mean and variance of its samples.

At k times the table's ISO speed a count stands for k times fewer electrons, so shot becomes k · shot. Read noise that
arises before the amplifier grows with k, what arises behind does not. How it is divided cannot be told from one speed;
`SENSOR_ELECTRONS` is assumed unless a number is given.

A normal deviate is one of 2¹⁴ numbers, the quantiles of the standard normal distribution at (i + ½) / 2¹⁴, scaled so
that their variance is 1; their mean is 0 to the last bit. They reach 4.0 standard deviations, beyond which lie 6 of
100 000 normal numbers.
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


BITS: Final = 14  # Of a random word that choose a deviate: 64 KiB of them stay in the second-level cache


@lru_cache(maxsize=1)
def normal_deviates() -> npt.NDArray[np.float32]:
    """Return the deviates (16384,) float32, rising."""
    half = 1 << (BITS - 1)
    upper = np.array([NormalDist().inv_cdf(0.5 + (place + 0.5) / (2 * half)) for place in range(half)])
    upper /= np.sqrt(np.mean(upper**2))
    return np.concatenate([-upper[::-1], upper]).astype(np.float32)


Three = tuple[float, float, float]

# Read noise of a photosite before the amplifier, electrons: sensors of 2008 to 2020 have some 2 to 3 at their highest
# speeds, where nothing else is left (W. Claff, photonstophotos.net, input-referred read noise); chosen, not measured.
SENSOR_ELECTRONS: Final = 2.5

# Photosites whose mean a sample of red, green and blue is: those of the half-size image of a Bayer mosaic.
_PHOTOSITES: Final = (1, 2, 1)


@dataclass(frozen=True)
class SensorNoise:
    """The noise of red, green and blue samples: variance = read² + shot · mean.

    - `read`: counts, from 0.
    - `shot`: counts: variance for each count of the mean, from 0.

    Examples
    --------
    >>> noise = SensorNoise(read=(6.0, 4.2, 6.0), shot=(0.56, 0.28, 0.56))
    >>> noise.at(4.0).shot
    (2.24, 1.12, 2.24)
    """

    read: Three
    shot: Three

    def at(self, ratio: float, sensor_electrons: float = SENSOR_ELECTRONS) -> SensorNoise:
        """Return the noise at `ratio` ≥ 1 times the ISO speed, for samples of the same mean.

        `ratio`: ISO speed over that of these samples.
        """
        read: list[float] = []
        for counts, shot, photosites in zip(self.read, self.shot, _PHOTOSITES, strict=True):
            early = min(counts**2, photosites * (sensor_electrons * shot) ** 2)
            read.append(float(np.sqrt(counts**2 + (ratio**2 - 1) * early)))
        return SensorNoise(_three(read), _three([ratio * shot for shot in self.shot]))

    def describe(self) -> dict[str, Any]:
        """Return the numbers as plain values."""
        return {"read": list(self.read), "shot": list(self.shot)}


def measured_noise(lut: Lut) -> SensorNoise:
    """Return the noise of a table's samples; an InputError as of `noise_curve`.

    Numbers have six digits, so that they are the same wherever a dataset is made.
    """
    # What measures noise also reads charts: who makes images alone is not to wait for its import.
    # It loads scipy and cv2.
    from calibration.radiometry.table_noise import noise_curve

    curve = noise_curve(lut)
    if curve is None:
        return SensorNoise((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    shot = [0.0 if not np.isfinite(gain) else 1 / gain for gain in curve.gain_e.tolist()]
    return SensorNoise(_three(curve.read_noise.tolist()), _three(shot))


def _three(numbers: list[float]) -> Three:
    red, green, blue = (float(f"{number:.6g}") for number in numbers)
    return red, green, blue
