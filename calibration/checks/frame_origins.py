"""Whether the frames of a session are of one camera, one lens and one exposure, as their files state them.

Most frames have what the session has; a frame that states otherwise is one that does not belong. What a file does not
state is not held against it: `calibration.checks.light_codes` sees by the light alone what such files hide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.raw.rawfile import FrameOrigin
from experiment.session.records import FrameRecord


@dataclass(frozen=True)
class ForeignFrame:
    """A frame whose file states another camera, lens or exposure than most.

    - `found`, `expected`: what it states, and what most state, in words.
    - `ratio`: its exposure over that of most; 1 where another thing differs.
    """

    record: FrameRecord
    found: str
    expected: str
    ratio: float = 1.0


@dataclass(frozen=True)
class OriginFigures:
    """What the files of a session state of where they come from.

    - `other_camera`: frames of another model or body.
    - `other_lens`: frames through another lens.
    - `other_exposure`: frames exposed otherwise by a hundredth or more.
    - `other_iso`: frames of another ISO speed.
    - `stating_camera`, `stating_exposure`: how many frames state them at all.
    """

    other_camera: tuple[ForeignFrame, ...] = ()
    other_lens: tuple[ForeignFrame, ...] = ()
    other_exposure: tuple[ForeignFrame, ...] = ()
    stating_camera: int = 0
    stating_exposure: int = 0
    other_iso: tuple[ForeignFrame, ...] = ()

    @property
    def exposure_difference(self) -> float:
        """By how much the exposure of a frame differs from that of most, the largest, a share: 1 is twice or half."""
        return max((max(frame.ratio, 1 / frame.ratio) - 1 for frame in self.other_exposure), default=0.0)


_SAME_EXPOSURE = 1.01
"""Ratio below which two exposures count as one: shutter speeds differ by 1.26 at least, and are written rounded."""


def origin_figures(frames: Sequence[tuple[FrameRecord, FrameOrigin]]) -> OriginFigures:
    """Return which frames are of another camera, lens or exposure than most, in the order given."""
    bodies = [(record, _body(origin)) for record, origin in frames if origin.camera or origin.serial]
    lenses = [(record, origin.lens) for record, origin in frames if origin.lens]
    return OriginFigures(
        other_camera=_others(_stated_alike(bodies)),
        other_lens=_others(lenses),
        other_exposure=_other_exposures(frames),
        stating_camera=len(bodies),
        stating_exposure=sum(origin.exposure > 0 for _, origin in frames),
        other_iso=_others([(record, f"ISO {origin.iso}") for record, origin in frames if origin.iso]),
    )


def _body(origin: FrameOrigin) -> str:
    return f"{origin.camera} no. {origin.serial}" if origin.serial else origin.camera


def _stated_alike(bodies: Sequence[tuple[FrameRecord, str]]) -> Sequence[tuple[FrameRecord, str]]:
    """Return the bodies without serial numbers where some frames of a model state none."""
    models = {body.split(" no. ")[0] for _, body in bodies if " no. " not in body}
    return [(record, body.split(" no. ")[0] if body.split(" no. ")[0] in models else body) for record, body in bodies]


def _others(stated: Sequence[tuple[FrameRecord, str]]) -> tuple[ForeignFrame, ...]:
    if not stated:
        return ()
    usual = Counter(value for _, value in stated).most_common(1)[0][0]
    return tuple(ForeignFrame(record, value, usual) for record, value in stated if value != usual)


def _other_exposures(frames: Sequence[tuple[FrameRecord, FrameOrigin]]) -> tuple[ForeignFrame, ...]:
    known = [(record, origin) for record, origin in frames if origin.exposure > 0]
    if not known:
        return ()
    usual = Counter(origin.exposure for _, origin in known).most_common(1)[0][0]
    example = next(origin for _, origin in known if origin.exposure == usual)
    found: list[ForeignFrame] = []
    for record, origin in known:
        # Where one of two states no f-number, the lens is taken to be as it is in the other.
        both = bool(origin.aperture) == bool(example.aperture)
        ratio = origin.exposure / usual if both else _light(origin) / _light(example)
        if not 1 / _SAME_EXPOSURE < ratio < _SAME_EXPOSURE:
            found.append(ForeignFrame(record, origin.exposure_text, example.exposure_text, ratio))
    return tuple(found)


def _light(origin: FrameOrigin) -> float:
    return (origin.shutter_s or 0.0) * (origin.iso or 0)
