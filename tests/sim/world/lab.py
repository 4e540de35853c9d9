"""CIELAB of prints, and the target of the managed profile of a paper."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim import spectral
from sim.spectral import PaperName


def intended_lab(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the target CIELAB (N, 3) float64 of the managed profile under D50, relative to paper, for codes (N, 3)."""
    return spectral._lab(spectral._target_xyz(np.asarray(rgb, dtype=np.float64) / 255, spectral._black_point(on)))


def relative_lab(reflectance: NDArray[np.float64], on: PaperName = "poster") -> NDArray[np.float64]:
    """Return CIELAB (N, 3) float64 of reflectances (N, 81) under D50 (CIE 1931 observer), relative to paper."""
    observer = spectral._observer()
    return spectral._lab(reflectance @ observer / (spectral.paper(on).white @ observer))
