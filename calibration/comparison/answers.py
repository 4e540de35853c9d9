"""Whether two tables are the same within noise: three questions, each with its limits and their reasons.

With 700 lights and 32 768 cells any difference is significant, however small. So what is asked is not whether noise is
the only cause, but whether what is beyond it matters: limits are those of noise at a chance of one in a hundred for the
whole table, widened by what standard errors that are themselves estimated may be off, and a floor of what no use of a
table would notice.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calibration.comparison.values import CellDifferences, LightDifferences, NoiseAnswer
from experiment.measures.stains import STAINED
from foundation.errors import first_of

CHANCE = 0.01
"""With which noise alone makes any light of a whole table differ."""

ERROR_OF_ERRORS = 1.3
"""By how much the whites' standard errors may be too small: they are the scatter about a polynomial that was fitted to
the same references, with up to a third as many terms (a factor of 1.22), from references few in number."""

ANGLE_FLOOR_DEG = 0.005
"""Angle that is called none (judgement): a two-hundredth of a good method's error of one degree."""

BRIGHTNESS_FLOOR = 0.002
"""Difference of brightness that is called none: fields that were fitted anew on another sheet leave up to 0.17 % in
the whites of a small simulated chart; a fifth of the drift that is usual in a session."""

CELL_SCORE = 1.1
"""Root mean square of cells in units of their noise up to which noise is the cause: what is beyond is then less than
half of the noise of a single cell of 25 samples. Sessions of one simulated room with other noise give 1.00 to 1.05."""

LIGHT_SCORE = 1.3
"""The same of one light's cells."""

CELL_SIGMAS = 6.0
"""Standard errors by which a cell's mean over all lights must differ to be named; by chance one of 5·10⁸."""

CELL_FLOOR = STAINED
"""Relative difference that it must have, too: that from which on `build-lut` calls a cell stained. Pixels are taken
whole, so a cell of 9 px that lies a fraction of one elsewhere takes in 1.5 % more or less of a bright neighbour."""

_Array = npt.NDArray[np.float64]


def answers_of(lights: LightDifferences, cells: CellDifferences) -> tuple[NoiseAnswer, ...]:
    """Return whether the lights' colour, their brightness, and the cells are the same within noise."""
    return _colour(lights), _brightness(lights), _cells(lights, cells)


def differing_lights(lights: LightDifferences) -> npt.NDArray[np.int64]:
    """Return (K,) int64 the places, among the compared lights, of those whose colour differs; the worst first."""
    beyond = np.flatnonzero((lights.angle_score > _most_score(len(lights.one))) & (lights.angle_deg > ANGLE_FLOOR_DEG))
    return beyond[np.argsort(-lights.angle_deg[beyond])]


def differing_cells(cells: CellDifferences) -> npt.NDArray[np.int64]:
    """Return (K,) int64 the colours whose mean over the lights differs from that of the others; the worst first."""
    with np.errstate(invalid="ignore"):
        off = np.abs(cells.mean - cells.offset)
        beyond = np.flatnonzero(((off > CELL_SIGMAS * cells.noise) & (off > CELL_FLOOR)).any(axis=1))
    return beyond[np.argsort(-np.nanmax(off[beyond], axis=1))] if len(beyond) else beyond


def _most_score(count: int) -> float:
    """Return the score that noise alone exceeds in any of `count` lights with `CHANCE`: χ² of two freedoms."""
    return ERROR_OF_ERRORS * float(np.sqrt(np.log(count / CHANCE)))


def _colour(lights: LightDifferences) -> NoiseAnswer:
    angle, noise = lights.angle_deg, lights.angle_noise_deg
    worst = int(angle.argmax())
    said = f"median {np.median(angle):.4f}°, worst {angle[worst]:.4f}° (light {lights.one[worst]})"
    if not np.isfinite(lights.angle_score).any():
        return NoiseAnswer("colour of lights", None, f"{said}; what noise alone gives is not known of these tables")
    beyond = differing_lights(lights)
    said += f"; noise alone gives {np.nanmedian(noise):.4f}° RMS under the median light"
    if len(beyond):
        said += f"; {len(beyond)} of {len(angle)} lights are beyond it: {first_of(lights.one[beyond].tolist())}"
    return NoiseAnswer("colour of lights", not len(beyond), said)


def _brightness(lights: LightDifferences) -> NoiseAnswer:
    off, left, noise = lights.brightness, lights.brightness_left, lights.brightness_noise
    said = (
        f"{100 * float(np.median(off)):+.3f} % on the median, {100 * off.min():+.3f} to {100 * off.max():+.3f} %; "
        f"without the recorded drift and that median {100 * float(np.sqrt((left**2).mean())):.3f} % RMS, "
        f"{100 * np.abs(left).max():.3f} % at most"
    )
    if not np.isfinite(noise).any():
        return NoiseAnswer("brightness of lights", None, f"{said}; what noise alone gives is not known of these tables")
    # Two-sided and of one freedom, so bounded by the same tail as two.
    limit = np.maximum(_most_score(len(off)) * np.sqrt(2) * noise, BRIGHTNESS_FLOOR)
    beyond = int((np.abs(off) > limit).sum())
    said += f"; noise alone gives {100 * float(np.nanmedian(noise)):.3f} %"
    if beyond:
        still = int((np.abs(left) > limit).sum())
        said += f"; {beyond} of {len(off)} lights are beyond it, {still} without drift and median"
    return NoiseAnswer("brightness of lights", not beyond, said)


def _cells(lights: LightDifferences, cells: CellDifferences) -> NoiseAnswer:
    if not np.isfinite(cells.score):
        return NoiseAnswer("cells", None, "no cell is bright enough in both tables")
    named = differing_cells(cells)
    uneven = np.flatnonzero(lights.cell_score > LIGHT_SCORE)
    said = (
        f"{100 * cells.rms:.3f} % RMS of cells above 300 counts, of which noise explains "
        f"{100 * cells.predicted_rms:.3f} % and leaves {100 * cells.beyond_noise:.3f} %; "
        f"{cells.score:.3f} in units of noise"
    )
    if len(uneven):
        order = uneven[np.argsort(-lights.cell_score[uneven])]
        said += f"; {len(uneven)} lights are beyond {LIGHT_SCORE:g}: {first_of(lights.one[order].tolist())}"
    if len(named):
        said += f"; {len(named)} cells differ under all lights: {first_of(named.tolist())}"
    return NoiseAnswer("cells", cells.score <= CELL_SCORE and not len(uneven) and not len(named), said)
