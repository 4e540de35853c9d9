"""The light of the dark frames at every patch, to be subtracted: the projector's leak and the room's light.

A dark frame shows it at each cell, but with the noise of a few samples: 1.2 counts in a single frame, as much as the
light itself often is. So it is predicted, dark paper × field × the cell's reflectance, and what cells show beyond the
prediction is added as far as it is more than noise: the share w = 1 − noise² / variance of what is left over, one for
each channel (empirical Bayes; B. Efron and C. Morris, Journal of the American Statistical Association 68, 1973).

Why so: `docs/decisions/0009-dark-light-is-predicted.md`.

Rules that hold inside:

- A frame's dark light is that of the last dark frame taken before it, or of the first, for frames before that.
- The estimate after a dark frame depends on those before it alone, so that a build that was stopped goes on to the same
  bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from experiment.measures.paper import Paper
from foundation.robust import MAD_TO_SIGMA

_LEAST_WHITE = 50.0
"""Counts that paper must have in a channel for a cell's reflectance to be read there."""

_MOST_REFLECTANCE = 1.5
"""Of bare paper's: no print reflects more, but noise in a dim channel may seem to."""

_FAR_SIGMA = 6.0
"""Standard deviations from its patch's median up to which a sample is light: read noise alone passes 6 σ once in 2.5
million samples, a chart's."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DarkLight:
    """What is to be subtracted from frames.

    - `paper`: (3,) float64 counts, of bare paper with the field divided out: for the record.
    - `patches`: (P, 3) float32 counts, of each patch as the camera sees it, field and all.
    - `share`: (3,) float64, 0 … 1, how much of what cells show beyond the prediction was added.
    """

    paper: _Array
    patches: npt.NDArray[np.float32]
    share: _Array


def winsorised_means(samples: npt.NDArray[np.float32], noise: _Array) -> _Array:
    """Return the winsorised means of dark samples, since a hot photosite or a cosmic ray is no light.

    `samples`: (P, S, 3) float32 counts above black; those beyond 6 σ of their patch's median count as if they were
    there. `noise`: (3,) float64 counts, σ of one sample. Returns (P, 3) float64 counts.
    """
    middle = np.median(samples, axis=1, keepdims=True)
    far = (_FAR_SIGMA * noise).astype(np.float32)
    return np.clip(samples, middle - far, middle + far).mean(axis=1, dtype=np.float64)


def reflectances(seen: _Array, field: _Array, white: _Array) -> _Array:
    """Return the reflectance (P, 3) float64 of patches, 1 = bare paper.

    `seen`: (P, 3) mean counts above black in a frame of even light. `field`: (P, 3) its flat field at the patches.
    `white`: (3,) counts of bare paper in it. A channel without light has the reflectances of the brightest one.
    """
    found = np.clip(seen / (field * np.maximum(white, _LEAST_WHITE)), 0, _MOST_REFLECTANCE)
    found[:, white < _LEAST_WHITE] = found[:, [int(np.argmax(white))]]
    return found


class DarkLightEstimator:
    """Estimates the dark light from dark frames, one after another.

    `reflectance`: (P, 3) of each patch. `inside`: (P,) whether a patch lies in the frame.
    """

    def __init__(self, reflectance: _Array, inside: npt.NDArray[np.bool_], samples: int) -> None:
        self._reflectance, self._inside, self._samples = reflectance, inside, samples
        self._left = np.zeros_like(reflectance)
        self._noise = np.zeros(3)
        self._frames = 0
        self._current: DarkLight | None = None

    @property
    def current(self) -> DarkLight | None:
        """The dark light of the last dark frame; None before the first."""
        return self._current

    def restart(self) -> None:
        """Drop what cells showed beyond the prediction: they lie on other photosites from now on."""
        self._left[:] = 0
        self._noise[:] = 0
        self._frames = 0

    def add(self, means: _Array, noise: _Array, paper: Paper, field: _Array) -> DarkLight:
        """Take in a dark frame and return what is to be subtracted from those after it.

        `means`: (P, 3) mean counts above black of each patch. `noise`: (3,) standard deviation of one sample. `field`:
        (P, 3) its field at the patches.
        """
        predicted = paper.white * field * self._reflectance
        self._left += means - predicted
        self._noise += noise**2 / self._samples
        self._frames += 1
        left = self._left / self._frames
        spread = MAD_TO_SIGMA * np.median(np.abs(left[self._inside] - np.median(left[self._inside], axis=0)), axis=0)
        chance = self._noise / self._frames**2
        share = np.clip(1 - chance / np.maximum(spread**2, 1e-12), 0, 1)
        self._current = DarkLight(paper.white, (predicted + share * left).astype(np.float32), share)
        return self._current

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that is needed to go on: arrays by name; none before the first frame.

        `dark_left` (P, 3) float64, `dark_noise` (3,) float64, `dark_frames` scalar int64, `dark_paper` (3,) float64,
        `dark_patches` (P, 3) float32, `dark_share` (3,) float64.
        """
        if self._current is None:
            return {}
        return {
            "dark_left": self._left,
            "dark_noise": self._noise,
            "dark_frames": np.array(self._frames),
            "dark_paper": self._current.paper,
            "dark_patches": self._current.patches,
            "dark_share": self._current.share,
        }

    def restore(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Go on from what `to_arrays` returned: (P, 3) and (3,) float arrays by name."""
        if "dark_left" not in arrays:
            return
        self._left, self._noise = arrays["dark_left"], arrays["dark_noise"]
        self._frames = int(arrays["dark_frames"])
        self._current = DarkLight(arrays["dark_paper"], arrays["dark_patches"], arrays["dark_share"])
