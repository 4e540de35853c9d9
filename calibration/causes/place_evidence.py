"""What is known of a place on the print that deviates: in which frames, how large, of which colour, added or taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calibration.causes.evidence import Evidence
from calibration.figures.frame_figures import FrameFigures
from calibration.figures.table_figures import TableFigures
from calibration.sampling import bleed
from experiment.limits.bleed import WINDOW_PX
from experiment.measures.reflections import cell_mm, joined_cells, light_of_spot, spot_colour, spots_of
from experiment.measures.stains import Stains
from experiment.session.records import FrameRecord

LEAST_BLOCK = 0.004
"""Deviation of a block beyond noise from which on a frame shows something there: clean frames in the simulated room
have less."""

SAME_THING = 0.3
"""Share of the worst frame's deviation from which on another frame shows the same."""

MOST_PLACES = 12
"""Places that are named and drawn of one figure: more hide the picture."""

IN_FIRST = 0.8
"""Share of the frames that differ from the first at a place from which on it is the first that differs."""

_HALF = 0.5
"""Share of a deviation in the mean of white frames that a single frame must have at least to be what made it."""

_LEAST_RESIDUAL = 0.02
"""Residual of references from which on something lies there: their noise under white is a tenth of it."""

RIM_OFF = -0.005
"""Mean residual of the outermost references below which a frame's corners are darker than its field."""

_LEAST_BRIGHT = 4
"""Cells of a small place from which on light was added if all of them are brighter."""

_MOSTLY = 0.8
"""Share of the cells of a small place that a thin shadow darkens at least (chosen: all of them, but for noise)."""

_COVERED = 0.1
"""Deviation that what covers cells gives one of them at least, unless it darkens all (chosen: of a hand's reflectance
are few colours of a print within a tenth)."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PrintPlace:
    """A place on the print.

    - `file`: the frame in which it is seen best.
    - `x_mm`, `y_mm`: its middle, from the sheet's top-left corner.
    - `size_mm`: its diameter; 0 for a cell.
    """

    file: str
    x_mm: float
    y_mm: float
    size_mm: float


@dataclass(frozen=True)
class Gathered:
    """What was gathered for a figure: evidence, the frames that show it, and where."""

    evidence: Evidence
    frames: tuple[FrameRecord, ...]
    places: tuple[PrintPlace, ...]


def block_evidence(figures: TableFigures, worst: FrameFigures, limit: float, softer: float) -> Gathered:
    """Return what is known of the place that deviates most in one frame from the frame registered first.

    `softer`: light of neighbouring cells added by the frame's blur, a share.
    """
    seen = worst.consistency
    at_mm, size_mm = np.array(seen.at_mm), max(seen.extent_mm, 1e-9)
    deviation, tint = _colour(np.array(seen.colour))
    evidence = Evidence(
        **_across_frames(figures, at_mm, size_mm, SAME_THING * seen.block),
        spot=_spot_share(figures.cells.stains, at_mm, size_mm),
        share=seen.share,
        deviation=deviation,
        tint=tint,
        added=seen.added,
        kept=seen.kept,
        scatter=seen.scatter,
        softer=softer,
        hot=_hot_share(figures, at_mm, size_mm),
        moved_px=worst.shift.length_px,
    )
    in_first = evidence.in_first == 1
    frames = [figures.registered_frame] if in_first else _frames_beyond(figures, worst, limit)
    x, y = seen.at_mm
    if in_first and (lying := reference_evidence(figures, figures.registered_frame)[1]):
        # Cells under it were not compared, as they did not look like the chart's.
        x, y = lying[0].x_mm, lying[0].y_mm
    place = PrintPlace(frames[0].record.file, x, y, size_mm)
    return Gathered(evidence, tuple(frame.record for frame in frames), (place,))


def covered_deviation(off: npt.NDArray[np.float64]) -> float:
    """Return how far cells are off that something may cover; NaN where they do not look covered.

    `off`: (N,) float64 deviations of cells next to each other, shares with their signs; 0 of those that are not known.
    """
    seen = off[off != 0]
    darker = seen[seen < 0]
    if not len(darker):
        # Few cells that are brighter may be dark ones that a hand covers.
        return float(np.median(seen)) if len(seen) >= _LEAST_BRIGHT else np.nan
    # As many brighter as darker ones, all by little, is what cells show that have some of their neighbours' light.
    mixed = len(darker) < _MOSTLY * len(seen) and np.abs(seen).max() < _COVERED
    return np.nan if mixed else float(darker.min())


def disturbed_evidence(figures: TableFigures, softer: float) -> Gathered | None:
    """Return what is known of the cells that something small covers in lights' frames; None where there are none.

    `softer`: light of neighbouring cells added by the worst frame's blur, a share.
    """
    lights = [frame for frame in figures.frames if frame.record.kind == "light" and frame.consistency.disturbed]
    if not lights:
        return None
    lights.sort(key=lambda frame: -len(frame.consistency.disturbed))
    worst, stains, first = lights[0], figures.cells.stains, figures.registered_frame
    cells = np.array([cell for cell, _ in worst.consistency.disturbed], dtype=np.int64)
    off = np.array([off for _, off in worst.consistency.disturbed])
    others = [frame for frame in figures.frames if frame is not first]
    whites = [frame for frame in others if frame.record.kind == "white"]

    def showing(among: list[FrameFigures]) -> float:
        same = [any(cell in cells for cell, _ in frame.consistency.disturbed) for frame in among]
        return sum(same) / max(len(among), 1)

    deviation = covered_deviation(off)
    evidence = Evidence(
        frames=float(len(others)),
        showing=showing(others),
        even_showing=showing(whites),
        in_first=float(showing(others) >= IN_FIRST),
        spot=float((stains.stained | stains.doubtful)[cells].mean()) if stains.known else np.nan,
        share=len(cells) / len(stains.places_mm),
        deviation=deviation,
        scatter=worst.consistency.scatter,
        softer=softer,
    )
    places: list[PrintPlace] = []
    for frame in lights[:MOST_PLACES]:
        own = np.array([cell for cell, _ in frame.consistency.disturbed], dtype=np.int64)
        places += [_place_of(stains, spot, frame.record.file) for spot in joined_cells(stains, own)]
    return Gathered(evidence, tuple(frame.record for frame in lights), tuple(places[:MOST_PLACES]))


def print_evidence(figures: TableFigures, figure: str) -> Gathered | None:
    """Return what is known of the print's largest spot, of unfit cells, or of what the field leaves."""
    if figure == "reference_spread":
        return _of_references(figures)
    stains = figures.cells.stains
    if figure == "unfit_share":
        kinds = [cell.cause.split(":")[0] for cell in figures.cells.unfit]
        common = max(dict.fromkeys(kinds), key=kinds.count, default="")
        if common != "stained":
            colours = np.array([cell.colour for cell in figures.cells.unfit], dtype=np.int64)
            hot = kinds.count("hot") / max(len(kinds), 1) if figures.dark_frames.files else np.nan
            file = figures.registered_frame.record.file
            points = stains.places_mm[colours[[kind == common for kind in kinds]]][:MOST_PLACES].tolist()
            places = tuple(PrintPlace(file, x, y, 0.0) for x, y in points)
            if common == "disturbed" and (covered := disturbed_evidence(figures, 0.0)) is not None:
                return covered
            if common != "covered":
                known = lens_evidence(figures) | {"misplaced": kinds.count("misplaced") / len(kinds), "hot": hot}
                return Gathered(Evidence(**known), (), places)
            known, lying = reference_evidence(figures, figures.registered_frame)
            frames = (figures.registered_frame.record,) if known else ()
            return Gathered(Evidence(**known | {"hot": hot}), frames, lying or places)
    spots = spots_of(stains)
    if not spots:
        return None
    gathered = _of_spot(figures, stains, spots[0])
    file = gathered.places[0].file
    more = tuple(_place_of(stains, spot, file) for spot in spots[1:MOST_PLACES])
    return replace(gathered, places=(*gathered.places, *more))


def lens_evidence(figures: TableFigures) -> dict[str, float]:
    """Return what is known of what the lens brings into cells, and of the sheet's flatness, by `Evidence`'s names."""
    registration, unfit = figures.registration, figures.cells.unfit
    known = {"waves_px": registration.lens_residual_px / registration.clearance}
    # A window that is too large sees the neighbours through any lens.
    if figures.cells.window <= WINDOW_PX:
        core = bleed(registration.cell_px, registration.blur_px, figures.cells.window)
        known["beyond_cell"] = core + figures.lens.beyond_cell
    if unfit:
        known["uneven"] = sum(cell.cause.startswith("uneven") for cell in unfit) / len(unfit)
    return known


def _of_spot(figures: TableFigures, stains: Stains, spot: npt.NDArray[np.int64]) -> Gathered:
    """Return what is known of one spot of the print."""
    place = _place_of(stains, spot, figures.registered_frame.record.file)
    at_mm = np.array([place.x_mm, place.y_mm])
    colour = spot_colour(stains, spot)
    deviation, tint = _colour(colour)
    added, kept = light_of_spot(stains, spot, int(np.argmax(np.abs(colour))))
    size_mm, least = max(place.size_mm, 1e-9), _HALF * abs(deviation)
    hottest = figures.dark_frames.hottest
    white_residual = _white_residual(figures, at_mm, place.size_mm, least)
    evidence = Evidence(
        **_across_frames(figures, at_mm, size_mm, least),
        white_residual=white_residual,
        some_whites=float(0 < white_residual < 1),
        rim_frames=float(np.mean([frame.paper.left.rim < RIM_OFF for frame in figures.white_frames] or [0])),
        spot=1.0,
        share=len(spot) / len(stains.places_mm),
        deviation=deviation,
        tint=tint,
        added=added,
        kept=kept,
        scatter=figures.registered_frame.consistency.scatter,
        softer=0.0,
        hot=float((hottest[spot] > 0).mean()) if len(hottest) == len(stains.places_mm) else np.nan,
    )
    frames: list[FrameFigures] = []
    if evidence.in_first == 1:
        frames = [figures.registered_frame]
    elif 0 < white_residual <= _HALF:
        frames = _white_off(figures, at_mm, place.size_mm, least)
    elif evidence.even_showing > 0:
        frames = [frame for frame in _showing(figures, at_mm, size_mm, least) if frame.record.kind == "white"]
    if frames:
        place = replace(place, file=frames[0].record.file)
    return Gathered(evidence, tuple(frame.record for frame in frames), (place,))


def _white_off(figures: TableFigures, at_mm: _Array, size_mm: float, least: float) -> list[FrameFigures]:
    """Return the white frames whose references are off at a place by `least` or more."""
    reach = max(size_mm, 3 * cell_mm(figures.cells.stains))
    return [
        frame
        for frame in figures.white_frames
        if abs(_colour(np.array(frame.paper.left.deviation))[0]) >= max(least, _LEAST_RESIDUAL)
        and float(np.linalg.norm(np.array(frame.paper.left.at_mm) - at_mm)) < reach
    ]


def _white_residual(figures: TableFigures, at_mm: _Array, size_mm: float, least: float) -> float:
    """Return the share of the white frames whose references are off at a place by `least` or more."""
    whites = figures.white_frames
    return len(_white_off(figures, at_mm, size_mm, least)) / len(whites) if whites else 0.0


def reference_evidence(figures: TableFigures, frame: FrameFigures) -> tuple[dict[str, float], tuple[PrintPlace, ...]]:
    """Return what a frame's references show where they deviate most, by the names of `Evidence`, and that place.

    Nothing where the frame is not white, there is no other white one, or they do not deviate.
    """
    whites, left = figures.white_frames, frame.paper.left
    deviation, tint = _colour(np.array(left.deviation))
    if frame not in whites or len(whites) < 2 or abs(deviation) < _LEAST_RESIDUAL:
        return {}, ()
    at_mm, near_mm = np.array(left.at_mm), 0.25 * float(np.hypot(*np.ptp(figures.cells.stains.places_mm, axis=0)))

    def is_off(other: FrameFigures) -> bool:
        seen = other.paper.left
        apart = float(np.linalg.norm(np.array(seen.at_mm) - at_mm))
        return abs(_colour(np.array(seen.deviation))[0]) >= _HALF * abs(deviation) and apart < near_mm

    known = {
        "white_residual": float(np.mean([is_off(other) for other in whites])),
        "deviation": deviation,
        "tint": tint,
        "share": left.share,
        "rim_frames": float(np.mean([other.paper.left.rim < RIM_OFF for other in whites])),
    }
    x, y = left.at_mm
    return known, (PrintPlace(frame.record.file, x, y, 0.0),)


def _of_references(figures: TableFigures) -> Gathered | None:
    """Return what is known of the references about the flat field, in the white frame with the largest residuals."""
    whites = figures.white_frames
    if not whites:
        return None
    worst = max(whites, key=lambda frame: float(frame.paper.spread[int(np.argmax(frame.paper.white))]))
    left, stains = worst.paper.left, figures.cells.stains
    known, places = reference_evidence(figures, worst)
    known |= {
        "frames": float(len(whites)),
        "rim": left.rim,
        "radial": left.radial,
        "rim_frames": float(np.mean([frame.paper.left.rim < RIM_OFF for frame in whites])),
    }
    if 0 < known.get("white_residual", 0.0) <= _HALF:
        return Gathered(Evidence(**known), (worst.record,), places)
    at_mm = np.array(left.at_mm)
    near = [spot for spot in spots_of(stains) if _distance(stains, spot, at_mm) < 4 * cell_mm(stains)]
    if not near:
        place = PrintPlace(worst.record.file, *left.at_mm, 0.0)
        return Gathered(Evidence(**known), (), (place,))
    gathered = _of_spot(figures, stains, near[0])
    # The spot's colour and light are those of cells of all colours, and known better.
    return replace(gathered, evidence=Evidence(**known | gathered.evidence.known()))


def _across_frames(figures: TableFigures, at_mm: _Array, size_mm: float, least: float) -> dict[str, float]:
    """Return in which frames a place differs from the frame registered first, by the names of `Evidence`."""
    first = figures.registered_frame
    others = [frame for frame in figures.frames if frame is not first]
    if not others:
        return {}
    found = _showing(figures, at_mm, size_mm, least)
    whites = [frame for frame in others if frame.record.kind == "white"]
    showing = len(found) / len(others)
    return {
        "frames": float(len(others)),
        "showing": showing,
        "even_showing": sum(frame.record.kind == "white" for frame in found) / max(len(whites), 1),
        "in_first": float(showing >= IN_FIRST),
    }


def _showing(figures: TableFigures, at_mm: _Array, size_mm: float, least: float) -> list[FrameFigures]:
    """Return the frames that differ from the one registered first at a place, the worst first."""
    first = figures.registered_frame
    found = [
        frame
        for frame in figures.frames
        if frame is not first
        and frame.consistency.block >= max(least, LEAST_BLOCK)
        and float(np.linalg.norm(np.array(frame.consistency.at_mm) - at_mm))
        <= max(size_mm, frame.consistency.extent_mm)
    ]
    return sorted(found, key=lambda frame: -frame.consistency.block)


def _frames_beyond(figures: TableFigures, worst: FrameFigures, limit: float) -> list[FrameFigures]:
    beyond = [frame for frame in figures.frames if frame.consistency.block > limit]
    return sorted(beyond or [worst], key=lambda frame: -frame.consistency.block)


def _colour(colour: _Array) -> tuple[float, float]:
    """Return the deviation of the channel that is off most, and how unlike the channels are, over its size."""
    deviation = float(colour[int(np.argmax(np.abs(colour)))])
    lit = colour[colour != 0]
    return deviation, float(np.ptp(lit)) / max(abs(deviation), 1e-9) if len(lit) > 1 else 0.0


def _place_of(stains: Stains, spot: npt.NDArray[np.int64], file: str) -> PrintPlace:
    x, y = stains.places_mm[spot].mean(axis=0).tolist()
    return PrintPlace(file, x, y, 2 * float(np.sqrt(len(spot) / np.pi)) * cell_mm(stains))


def _distance(stains: Stains, spot: npt.NDArray[np.int64], at_mm: _Array) -> float:
    return float(np.linalg.norm(stains.places_mm[spot] - at_mm, axis=1).min())


def _spot_share(stains: Stains, at_mm: _Array, size_mm: float) -> float:
    """Return the share of the cells about a place that deviate in the mean of the white frames."""
    if not stains.known:
        return np.nan
    near = np.linalg.norm(stains.places_mm - at_mm, axis=1) < max(size_mm / 2, 2 * cell_mm(stains))
    return float((stains.stained | stains.doubtful)[near].mean()) if near.any() else np.nan


def _hot_share(figures: TableFigures, at_mm: _Array, size_mm: float) -> float:
    """Return the share of the cells about a place that hold a photosite hot in every dark frame."""
    hottest, places = figures.dark_frames.hottest, figures.cells.stains.places_mm
    if len(hottest) != len(places):
        return np.nan
    near = np.linalg.norm(places - at_mm, axis=1) < size_mm / 2
    return float((hottest[near] > 0).mean()) if near.any() else np.nan
