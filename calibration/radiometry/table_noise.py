"""Measure the photon-transfer curve of a LUT: variance of its samples against their mean."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from calibration.sampling import photon_transfer
from foundation.errors import InputError

if TYPE_CHECKING:
    from calibration.sampling import PhotonTransfer
    from calibration.table.lut import Lut

# Number of illuminants to measure. In a full LUT, each parameter of the curve is then accurate to 1 %.
_LIGHT_COUNT: Final = 6

# Largest RMS of the relative differences between variances and curve. Full simulated LUTs have 0.006, and LUTs with
# eight patches per level 0.1.
_MAX_MISFIT: Final = 0.25

_MIN_PATCHES: Final = 32  # minimum number of patches for a curve of three parameters


def noise_curve(lut: Lut) -> PhotonTransfer | None:
    """Return the photon-transfer curve of the samples of a LUT; None if they have no noise at all.

    The six illuminants with most counts in their weakest channel are used. Samples of 0 are clipped, so their noise is
    too small. Patches with such samples and unfit patches are excluded. `calibration.sampling` fits the curve.

    Raises
    ------
    InputError
        If the samples do not follow the curve, or too few patches are usable.
    """
    count = lut.samples.shape[2]
    lights = np.argsort(-lut.white.min(axis=1), kind="stable")[:_LIGHT_COUNT]
    unfit = np.array([cell.colour for cell in lut.provenance.unfit], dtype=np.int64)
    means: list[npt.NDArray[np.float64]] = []
    variances: list[npt.NDArray[np.float64]] = []
    for light in map(int, lights):
        samples = np.delete(np.asarray(lut.light_samples(light)), unfit, axis=0)
        samples = samples[(samples > 0).all(axis=(1, 2))].astype(np.float32)
        if count > 1:
            means.append(samples.mean(axis=1, dtype=np.float64))
            variances.append(samples.var(axis=1, ddof=1, dtype=np.float64))
    cells = sum(map(len, means))
    if cells < _MIN_PATCHES:
        raise InputError(
            f"the noise of {lut.folder} cannot be measured: {cells} patches have several samples above 0, expected "
            f"at least {_MIN_PATCHES}; omit --iso, --exposure and --gradient, or use another LUT"
        )
    curve = photon_transfer(np.concatenate(means), np.concatenate(variances), count)
    has_noise = np.concatenate(variances).max() > 0
    if has_noise and not curve.misfit.max() <= _MAX_MISFIT:
        raise InputError(
            f"the samples of {lut.folder} do not follow the photon-transfer curve: their variances differ by "
            f"{curve.misfit.max():.0%} RMS, expected at most {_MAX_MISFIT:.0%}; omit --iso, --exposure and --gradient, "
            "or use another LUT"
        )
    return curve if has_noise else None
