"""Whether a raw frame is well exposed: as asked for, neither clipped nor dark, and dark where it should be.

Counts and what the file says of its exposure; where the chart lies in the picture is the business of
`acquisition.framing.tags`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquisition.session.folder import FrameKind

if TYPE_CHECKING:
    from acquisition.config import LimitSettings
    from drivers.camera import ExposureSettings
    from drivers.raw.rawfile import Mosaic

CLIPPING_SHARE = 0.98
"""Counts above this share of saturation are treated as clipped (judgement: the knee of the response lies above)."""
BRIGHTEST_PERCENTILE = 99.9
EXPOSURE_TOLERANCE_STOPS = 0.25
"""How far a file's exposure may lie from the one asked for. Nominal values are rounded, and files state either: 0.3 s
stands for 0.354 s on a dial of half stops, which is 0.24 stops. A dial turned by one third differs by 0.2 to 0.5 stops
in what the file states, so that most such turns are seen, and every one of more."""


@dataclass(frozen=True)
class Exposure:
    """What a frame's counts say.

    Attributes
    ----------
    clipped
        Share of photosites at or above `CLIPPING_SHARE` of saturation, 0 … 1.
    brightest_dn
        `BRIGHTEST_PERCENTILE` of the counts above black, of the brightest Bayer phase.
    range_dn
        Saturation minus black.
    """

    clipped: float
    brightest_dn: float
    range_dn: float

    @property
    def level(self) -> float:
        """Brightest counts as a share of the sensor's range, 0 … 1."""
        return self.brightest_dn / self.range_dn


def measure_exposure(mosaic: Mosaic) -> Exposure:
    """Measure the counts of a mosaic's visible area; every fourth 2×2 block is enough for the percentile."""
    masked = mosaic.masked_black()
    black = mosaic.black if masked is None else masked
    clipped = np.count_nonzero(mosaic.counts >= CLIPPING_SHARE * mosaic.white_level) / mosaic.counts.size
    planes = mosaic.block_planes()[:, :, ::2, ::2].reshape(2, 2, -1)
    brightest = np.percentile(planes, BRIGHTEST_PERCENTILE, axis=2) - black
    return Exposure(float(clipped), float(brightest.max()), float(mosaic.white_level - black.mean()))


def disagreement(mosaic: Mosaic, asked: ExposureSettings) -> str | None:
    """Return how the exposure that a raw file states differs from the one asked for, or None where it does not.

    What the file does not state cannot differ, nor what it states as 0: the aperture of a lens without contacts.
    """
    differing = [
        f"{name} {stated:g} instead of {wanted:g}"
        for name, stated, wanted, stops in (
            ("ISO speed", mosaic.iso, asked.iso, 1),
            ("aperture", mosaic.aperture, asked.aperture, 2),
            ("shutter time in s", mosaic.shutter_s, asked.shutter_s, 1),
        )
        if stated and abs(stops * math.log2(stated / wanted)) >= EXPOSURE_TOLERANCE_STOPS
    ]
    if not differing:
        return None
    return f"the file states {', '.join(differing)}; was a dial of the camera turned?"


def refusal(exposure: Exposure, kind: FrameKind, limits: LimitSettings) -> str | None:
    """Return why a frame cannot be used, or None when it can."""
    if kind == "dark":
        if exposure.level * 100 > limits.stray_light_percent:
            return (
                f"the dark frame reaches {exposure.level:.1%} of saturation, {limits.stray_light_percent:g} % allowed; "
                "is another light on, or the projector's picture not black?"
            )
        return None
    if exposure.clipped * 100 > limits.clipped_percent:
        return (
            f"{exposure.clipped:.1%} of photosites clipped, {limits.clipped_percent:g} % allowed; "
            "expose shorter and begin a new session"
        )
    if exposure.brightest_dn < limits.too_dark_dn:
        return (
            f"the brightest photosites reach {exposure.brightest_dn:.0f} counts above black, "
            f"{limits.too_dark_dn:g} expected; is the projector on, its picture not muted, the lens cap off?"
        )
    return None
