"""Judge the exposure of a raw frame: as asked for, neither clipped nor too dark, and dark where it should be.

Reads counts and the exposure that the file states; where the chart lies in the picture is found by
`experiment.framing.finding`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.camera import ExposureSettings
from drivers.raw.rawfile import Mosaic, read_raw
from experiment.config import LabSettings, LimitSettings
from experiment.framing.planes import CLIPPING_SHARE, frame_black
from experiment.session.plan import FrameKind, SessionStep
from experiment.session.records import Judgement
from foundation.errors import FormatError

BRIGHTEST_PERCENTILE = 99.9
"""Percentile that stands for the brightest counts: bare paper fills more than a thousandth of a frame, hot photosites
and reflections less."""

EXPOSURE_TOLERANCE_STOPS = 0.25
"""How far a file's exposure may lie from the one asked for. Nominal values are rounded, and files state either: 0.3 s
stands for 0.354 s on a dial of half stops, which is 0.24 stops. A dial turned by one third differs by 0.2 to 0.5 stops
in what the file states, so that most such turns are seen, and every one of more."""


@dataclass(frozen=True)
class Exposure:
    """How bright a frame's counts are.

    - `clipped`: share of photosites at or above `CLIPPING_SHARE` of saturation, 0 … 1.
    - `brightest_dn`: `BRIGHTEST_PERCENTILE` of the counts above black, of the brightest position of the 2×2 block.
    - `range_dn`: saturation minus black.
    """

    clipped: float
    brightest_dn: float
    range_dn: float

    @property
    def level(self) -> float:
        """Brightest counts as a share of the sensor's range, 0 … 1."""
        return self.brightest_dn / self.range_dn


def measure_exposure(mosaic: Mosaic) -> Exposure:
    """Return how bright a mosaic's visible area is; every fourth 2×2 block is enough for the percentile."""
    black = frame_black(mosaic)
    clipped = np.count_nonzero(mosaic.counts >= CLIPPING_SHARE * mosaic.white_level) / mosaic.counts.size
    planes = mosaic.block_planes()[:, :, ::2, ::2].reshape(2, 2, -1)
    brightest = np.percentile(planes, BRIGHTEST_PERCENTILE, axis=2) - black
    return Exposure(float(clipped), float(brightest.max()), float(mosaic.white_level - black.mean()))


def disagreement(mosaic: Mosaic, asked: ExposureSettings) -> str | None:
    """Return how the exposure that a raw file states differs from the one asked for, or None where it does not.

    A value that the file does not state is passed over, and so is 0, the aperture of a lens without contacts.
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
            f"{exposure.clipped:.1%} of the photosites are clipped, {limits.clipped_percent:g} % allowed; "
            "dim the projector, or set a shorter exposure (acquire check recommends one) and begin a new session"
        )
    # Of the greys by which the projector's curve is known the darkest are meant to be dark.
    if kind != "response" and exposure.brightest_dn < limits.too_dark_dn:
        return (
            f"the brightest photosites are {exposure.brightest_dn:.0f} counts above black, "
            f"at least {limits.too_dark_dn:g} expected; is the projector on, its picture not muted, the lens cap off? "
            "If so, expose longer, in a new session"
        )
    return None


def judge_file(path: Path, kind: FrameKind, settings: LabSettings) -> str | None:
    """Decode a raw file and return why it cannot be used, or None when it can."""
    try:
        mosaic = read_raw(path)
    except FormatError as error:
        return str(error)
    # What was asked for is not known of frames taken by other means.
    differs = None if settings.rig == "imported" else disagreement(mosaic, settings.camera.exposure)
    return differs or refusal(measure_exposure(mosaic), kind, settings.limits)


class ExposureJudge:
    """A `experiment.session.records.FrameJudge` that looks at the exposure of each frame alone."""

    def __init__(self, settings: LabSettings) -> None:
        self._settings = settings

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return whether the frame can be read and is exposed as it should be."""
        return Judgement.of_reason("exposure", judge_file(file, step.kind, self._settings))

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Do nothing: no frame is held against another."""
