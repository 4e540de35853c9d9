"""The photon-transfer curve of a table: how the variance of its samples grows with their mean."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from calibration.sampling import photon_transfer
from foundation.errors import InputError

if TYPE_CHECKING:
    from calibration.sampling import PhotonTransfer
    from calibration.table.lut import Lut

_LIGHTS: Final = 6  # Lights whose cells are measured: 200 000 cells of a full table tell each number to a percent

# RMS by which variances may differ from the curve, relative: .006 in the simulated tables of two cameras, and .1
# where a table has so few cells that a level is known from eight.
_MISFIT: Final = 0.25

_FEWEST: Final = 32  # Cells that a curve of three numbers is fitted to at least


def noise_curve(lut: Lut) -> PhotonTransfer | None:
    """Return the photon-transfer curve of a table's samples; None where they have no noise at all.

    Read from the cells under up to six of its lights, those that are brightest in their darkest channel, so that
    dark samples, which are cut at 0 and hence too quiet, are few; cells with such a sample, and unfit cells, are left
    out. The curve is fitted by `calibration.sampling`.

    Raises `InputError`: the samples do not follow the curve, or too few cells can be read.
    """
    count = lut.samples.shape[2]
    lights = np.argsort(-lut.white.min(axis=1), kind="stable")[:_LIGHTS]
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
    if cells < _FEWEST:
        raise InputError(
            f"the noise of {lut.folder} cannot be measured: {cells} cells with several samples above 0, expected "
            f"{_FEWEST} or more; leave out --iso, --exposure and --gradient, or use another table"
        )
    curve = photon_transfer(np.concatenate(means), np.concatenate(variances), count)
    seen = np.concatenate(variances).max() > 0
    if seen and not curve.misfit.max() <= _MISFIT:
        raise InputError(
            f"the samples of {lut.folder} do not follow the photon-transfer curve: variances differ from it by "
            f"{curve.misfit.max():.0%} RMS, expected {_MISFIT:.0%} or less; leave out --iso, --exposure and "
            "--gradient, or use another table"
        )
    return curve if seen else None
