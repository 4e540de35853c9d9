"""What a figure beyond its limit is probably caused by, in which frames, and where on the print.

Evidence is gathered from figures that are there already; a figure without a gatherer, and one that no rule explains,
has no cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calibration.causes.cause import UNKNOWN
from calibration.causes.evidence import Evidence
from calibration.causes.light_evidence import (
    brightness_evidence,
    camera_evidence,
    dark_evidence,
    iso_evidence,
    light_evidence,
    name_evidence,
    stray_evidence,
)
from calibration.causes.place_evidence import (
    MOST_PLACES,
    Gathered,
    PrintPlace,
    block_evidence,
    disturbed_evidence,
    lens_evidence,
    print_evidence,
    reference_evidence,
)
from calibration.causes.rules import RULES, Decision, decide
from calibration.figures.frame_figures import FrameFigures
from calibration.figures.table_figures import TableFigures
from calibration.sampling import bleed
from experiment.session.records import FrameRecord


@dataclass(frozen=True)
class ProbableCause:
    """Why a figure is beyond its limit.

    - `figure`: name of its limit.
    - `decision`: the cause, and the rule that says so.
    - `evidence`: what it was decided by.
    - `frames`: the frames in which it shows, the worst first; empty where all share it.
    - `places`: where on the print.
    """

    figure: str
    decision: Decision
    evidence: Evidence
    frames: tuple[FrameRecord, ...]
    places: tuple[PrintPlace, ...]

    @property
    def is_known(self) -> bool:
        """Whether a cause is named."""
        return self.decision.cause is not UNKNOWN

    @property
    def is_of_frames(self) -> bool:
        """Whether it is mended by taking the frames named again."""
        return self.decision.cause.mends == "frames" and bool(self.frames)


def explain(figure: str, limit: float, figures: TableFigures) -> ProbableCause | None:
    """Return why a figure is beyond its limit; None for a figure that explains itself, such as the size of a cell."""
    gather = _GATHERERS.get(figure)
    if gather is None:
        return None
    gathered = gather(figures, limit)
    if gathered is None:
        return None
    found = ProbableCause(
        figure, decide(figure, gathered.evidence, RULES), gathered.evidence, gathered.frames, gathered.places
    )
    return found if found.is_known else _as_another(found, figures)


def _as_another(unknown: ProbableCause, figures: TableFigures) -> ProbableCause:
    """Return a finding with the cause of a figure that it goes with, in the same frames; as it is where there is none.

    What lies on the print in a frame spreads its cells; a light that bears another's name has another's brightness.
    """
    for name, limit in _GOES_WITH.get(unknown.figure, ()):
        main = explain(name, limit, figures)
        if main is None or not main.is_known or not main.frames:
            continue
        own, others = ({frame.sha256 for frame in finding.frames} for finding in (unknown, main))
        if own and own <= others:
            decision = replace(main.decision, follows=name)
            return replace(unknown, decision=decision, evidence=main.evidence, places=unknown.places or main.places)
    return unknown


def explained_figures() -> tuple[str, ...]:
    """Return the names of the limits for which evidence is gathered."""
    return tuple(_GATHERERS)


def added_bleed(figures: TableFigures, frame: FrameFigures) -> float:
    """Return how much more light a frame's worst sample has from beyond its cell than that of the registered frame."""
    registration, window = figures.registration, figures.cells.window
    return bleed(registration.cell_px, frame.blur_px, window) - bleed(
        registration.cell_px, registration.blur_px, window
    )


def _place_in_frame(figures: TableFigures, limit: float) -> Gathered | None:
    worst = _worst(figures, lambda frame: frame.consistency.block)
    if worst is None:
        return None
    return block_evidence(figures, worst, limit, added_bleed(figures, worst))


def _small_place(figures: TableFigures, limit: float) -> Gathered | None:
    worst = max(figures.frames, key=lambda frame: len(frame.consistency.disturbed))
    return disturbed_evidence(figures, added_bleed(figures, worst))


def _all_cells(figures: TableFigures, limit: float) -> Gathered | None:
    worst = _worst(figures, lambda frame: frame.consistency.scatter)
    if worst is None:
        return None
    beyond = [frame for frame in figures.frames if frame.consistency.scatter > limit]
    return _of_frames(figures, worst, beyond)


def _softer(figures: TableFigures, limit: float) -> Gathered | None:
    worst = _worst(figures, lambda frame: frame.blur_px)
    if worst is None:
        return None
    beyond = [frame for frame in figures.frames if added_bleed(figures, frame) > limit]
    return _of_frames(figures, worst, beyond)


def _moved(figures: TableFigures, limit: float) -> Gathered | None:
    anew = [frame for frame in figures.frames if frame.reregistered]
    if not anew:
        return None
    return _of_frames(figures, max(anew, key=lambda frame: frame.shift.length_px), anew)


def _found(figures: TableFigures, limit: float) -> Gathered:
    registered = figures.registered_frame
    gathered = _of_frames(figures, registered, [registered])
    # What lay on the print is seen by its references, where other white frames show them without it.
    known, places = reference_evidence(figures, registered)
    return Gathered(Evidence(**gathered.evidence.known() | known), gathered.frames, places)


def _noisy(figures: TableFigures, limit: float) -> Gathered | None:
    noisy, stains = np.asarray(figures.sensor.transfer.noisy), figures.cells.stains
    concerned = np.flatnonzero(noisy.any(axis=-1) if noisy.ndim > 1 else noisy)
    spotted = stains.stained | stains.doubtful
    if len(concerned) and stains.known and float(spotted[concerned].mean()) >= _MOSTLY:
        return print_evidence(figures, "doubtful_share")
    gathered = _found(figures, limit)
    hottest = figures.dark_frames.hottest
    hot = float((hottest[concerned] > 0).mean()) if len(hottest) and len(concerned) else np.nan
    file = figures.registered_frame.record.file
    places = tuple(PrintPlace(file, x, y, 0.0) for x, y in stains.places_mm[concerned[:MOST_PLACES]].tolist())
    known = gathered.evidence.known()
    frames = gathered.frames if "white_residual" in known else ()
    return Gathered(Evidence(**known | lens_evidence(figures) | {"hot": hot}), frames, places)


def _additivity(figures: TableFigures, limit: float) -> Gathered | None:
    light = light_evidence(figures, limit)
    return light if light.frames else name_evidence(figures, _OFF_CODES_DEG)


def _drift(figures: TableFigures, limit: float) -> Gathered | None:
    light = light_evidence(figures, limit)
    worst = max(figures.white_frames, key=lambda frame: frame.consistency.block, default=None)
    if worst is None or light.frames or not worst.consistency.block > _DISTURBED:
        return light
    block = block_evidence(figures, worst, _DISTURBED, added_bleed(figures, worst))
    known = block.evidence.known() | light.evidence.known() | {"frames": block.evidence.frames}
    return Gathered(Evidence(**known), block.frames, block.places)


def _of_frames(figures: TableFigures, worst: FrameFigures, beyond: list[FrameFigures]) -> Gathered:
    """Return what is known of a frame as a whole; `beyond` are all frames that show it."""
    frames, ordered = figures.frames, sorted(beyond, key=lambda frame: frame is not worst)
    evidence = Evidence(
        frames=float(len(frames)),
        showing=len(beyond) / max(len(frames), 1),
        scatter=worst.consistency.scatter,
        softer=added_bleed(figures, worst),
        moved_px=worst.shift.length_px,
        anew=float(np.mean([frame.reregistered for frame in frames])) if frames else np.nan,
        agreement=figures.registration.agreement,
    )
    whole = len(beyond) == len(frames)
    return Gathered(evidence, () if whole else tuple(frame.record for frame in ordered), ())


def _worst(figures: TableFigures, value: Callable[[FrameFigures], float]) -> FrameFigures | None:
    return max(figures.frames, key=value, default=None)


_MOSTLY = 0.5
"""Share of noisy cells that lie in a spot of the print from which on the spot explains them."""

_DISTURBED = 0.03
"""Deviation of a block from which on what lies there moves the mean of the paper, too (judgement)."""

_OFF_CODES_DEG = 2.0
"""Angle from its codes from which a light may be what a sum of primaries is spoilt by: that of the limit on names."""

_GOES_WITH: dict[str, tuple[tuple[str, float], ...]] = {
    "unlike_scatter": (("unlike_block", 0.01), ("disturbed_cells", 0.0)),
    "disturbed_cells": (("unlike_block", 0.01),),
    "unfit_share": (("unlike_block", 0.01),),
    "off_brightness": (("off_codes_deg", _OFF_CODES_DEG), ("exchanged_lights", 0.0)),
}
"""Figures that others move along: each with those whose cause it shares where it has none of its own, and from which on
these are looked at."""

_GATHERERS: dict[str, Callable[[TableFigures, float], Gathered | None]] = {
    "unlike_block": _place_in_frame,
    "disturbed_cells": _small_place,
    "unlike_scatter": _all_cells,
    "softer_bleed": _softer,
    "moved_anew": _moved,
    "agreement": _found,
    "blocks_good": _found,
    "tags_found": _found,
    "noisy_share": _noisy,
    "doubtful_share": lambda figures, limit: print_evidence(figures, "doubtful_share"),
    "unfit_share": lambda figures, limit: print_evidence(figures, "unfit_share"),
    "added_light": lambda figures, limit: print_evidence(figures, "added_light"),
    "reference_spread": lambda figures, limit: print_evidence(figures, "reference_spread"),
    "additivity": _additivity,
    "white_short": light_evidence,
    "other_exposure": light_evidence,
    "off_brightness": brightness_evidence,
    "white_frame_brightness": light_evidence,
    "off_codes_deg": name_evidence,
    "exchanged_lights": name_evidence,
    "white_frame_deg": name_evidence,
    "other_camera": camera_evidence,
    "other_lens": camera_evidence,
    "white_drift": _drift,
    "white_drift_deg": _drift,
    "leak_share": dark_evidence,
    "dark_drift": dark_evidence,
    "stray_share": stray_evidence,
    "other_iso": iso_evidence,
}
"""How evidence is gathered for each figure."""
