"""What is known of a figure beyond its limit, gathered from what was measured: the evidence, its frames, its places.

One function an aspect, each `(table, limit)` to `Gathered`, or to None where nothing is known. `limit` is the figure's
own, from which on a frame or a light shows the same. First places on the print (in which frames, how large, of which
colour, added or taken), then frames as a whole, then lights (exposures by the files, names, light in the dark).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calibration.causes.rules import Evidence
from calibration.measurements import FrameMeasurements, TableMeasurements
from calibration.sampling import WINDOW, bleed
from experiment.measures.stains import Stains, cell_mm, joined_cells, light_of_spot, spot_colour, spots_of
from experiment.session.records import FrameRecord

# Deviation of a block beyond noise from which on a frame shows something there: clean frames in the simulated room
# have less.
LEAST_BLOCK = 0.004

SAME_THING = 0.3  # Share of the worst frame's deviation from which on another frame shows the same

MOST_PLACES = 12  # Places that are named and drawn of one figure: more hide the picture

IN_FIRST = 0.8  # Share of the frames that differ from the first at a place from which on it is the first that differs

# Share of a deviation in the mean of white frames that a single frame must have at least to be what made it.
_HALF = 0.5

# Residual of references from which on something lies there: their noise under white is a tenth of it.
_LEAST_RESIDUAL = 0.02

RIM_OFF = -0.005  # Mean residual of the outermost references below which a frame's corners are darker than its field

_LEAST_BRIGHT = 4  # Cells of a small place from which on light was added if all of them are brighter

# Share of the cells of a small place that a thin shadow darkens at least (chosen: all of them, but for noise).
_MOSTLY = 0.8

# Deviation that what covers cells gives one of them at least, unless it darkens all (chosen: of a hand's reflectance
# are few colours of a print within a tenth).
_COVERED = 0.1

_IN_SPOT = 0.5  # Share of noisy cells that lie in a spot of the print from which on the spot explains them

_DISTURBED = 0.03  # Deviation of a block from which on what lies there moves the mean of the paper, too (judgement)

# Logarithm of two exposures' ratio up to which they are one: shutter speeds differ by a quarter, and are rounded.
_SAME = 0.03

_Array = npt.NDArray[np.float64]


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


def block_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of the place that deviates most in any frame from the frame registered first."""
    return _block_of(table, max(table.frames, key=lambda frame: frame.consistency.block), limit)


def _block_of(table: TableMeasurements, worst: FrameMeasurements, limit: float) -> Gathered:
    seen = worst.consistency
    at_mm, size_mm = np.array(seen.at_mm), max(seen.extent_mm, 1e-9)
    deviation, tint = _colour(np.array(seen.colour))
    evidence = Evidence(
        **_across_frames(table, at_mm, size_mm, SAME_THING * seen.block),
        spot=_spot_share(table.cells.stains, at_mm, size_mm),
        share=seen.share,
        deviation=deviation,
        tint=tint,
        added=seen.added,
        kept=seen.kept,
        scatter=seen.scatter,
        softer=table.added_bleed(worst),
        hot=_hot_share(table, at_mm, size_mm),
        moved_px=worst.shift.length_px,
    )
    in_first = evidence.in_first == 1
    beyond = [frame for frame in table.frames if frame.consistency.block > limit] or [worst]
    frames = [table.registered_frame] if in_first else sorted(beyond, key=lambda frame: -frame.consistency.block)
    x, y = seen.at_mm
    if in_first and (lying := _of_residuals(table, table.registered_frame)[1]):
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


def disturbed_evidence(table: TableMeasurements, limit: float) -> Gathered | None:
    """Return what is known of the cells that something small covers in lights' frames; None where there are none."""
    most = max(table.frames, key=lambda frame: len(frame.consistency.disturbed))
    return _disturbed(table, table.added_bleed(most))


def _disturbed(table: TableMeasurements, softer: float) -> Gathered | None:
    """Return the same; `softer` is the light of neighbouring cells that the worst frame's blur adds, a share."""
    lights = [frame for frame in table.frames if frame.record.kind == "light" and frame.consistency.disturbed]
    if not lights:
        return None
    lights.sort(key=lambda frame: -len(frame.consistency.disturbed))
    worst, stains, first = lights[0], table.cells.stains, table.registered_frame
    cells = np.array([cell for cell, _ in worst.consistency.disturbed], dtype=np.int64)
    off = np.array([off for _, off in worst.consistency.disturbed])
    others = [frame for frame in table.frames if frame is not first]
    whites = [frame for frame in others if frame.record.kind == "white"]

    def showing(among: list[FrameMeasurements]) -> float:
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


def spot_evidence(table: TableMeasurements, limit: float) -> Gathered | None:
    """Return what is known of the print's largest spot; None where it has none."""
    stains = table.cells.stains
    spots = spots_of(stains)
    if not spots:
        return None
    gathered = _of_spot(table, stains, spots[0])
    file = gathered.places[0].file
    more = tuple(_place_of(stains, spot, file) for spot in spots[1:MOST_PLACES])
    return replace(gathered, places=(*gathered.places, *more))


def unfit_evidence(table: TableMeasurements, limit: float) -> Gathered | None:
    """Return what is known of the cells that are unfit for what most of them are."""
    kinds = [cell.kind for cell in table.cells.unfit]
    common = max(dict.fromkeys(kinds), key=kinds.count, default="stained")
    if common == "stained":
        return spot_evidence(table, limit)
    stains, registered = table.cells.stains, table.registered_frame.record
    colours = np.array([cell.colour for cell in table.cells.unfit], dtype=np.int64)
    hot = kinds.count("hot") / len(kinds) if table.dark_frames.files else np.nan
    points = stains.places_mm[colours[[kind == common for kind in kinds]]][:MOST_PLACES].tolist()
    places = tuple(PrintPlace(registered.file, x, y, 0.0) for x, y in points)
    if common == "disturbed" and (covered := _disturbed(table, 0.0)) is not None:
        return covered
    if common != "covered":
        known = _lens(table) | {
            "misplaced": kinds.count("misplaced") / len(kinds),
            "hot": hot,
            "lit": kinds.count("lit") / len(kinds),
        }
        return Gathered(Evidence(**known), (), places)
    known, lying = _of_residuals(table, table.registered_frame)
    return Gathered(Evidence(**known | {"hot": hot}), (registered,) if known else (), lying or places)


def noisy_evidence(table: TableMeasurements, limit: float) -> Gathered | None:
    """Return what is known of cells that are noisier than their level explains."""
    concerned, stains = np.flatnonzero(table.sensor.transfer.noisy), table.cells.stains
    spotted = stains.stained | stains.doubtful
    if len(concerned) and stains.known and float(spotted[concerned].mean()) >= _IN_SPOT:
        return spot_evidence(table, limit)
    gathered = chart_evidence(table, limit)
    hottest = table.dark_frames.hottest
    hot = float((hottest[concerned] > 0).mean()) if len(hottest) and len(concerned) else np.nan
    file = table.registered_frame.record.file
    places = tuple(PrintPlace(file, x, y, 0.0) for x, y in stains.places_mm[concerned[:MOST_PLACES]].tolist())
    known = gathered.evidence.known()
    frames = gathered.frames if "white_residual" in known else ()
    return Gathered(Evidence(**known | _lens(table) | {"hot": hot}), frames, places)


def _lens(table: TableMeasurements) -> dict[str, float]:
    """Return what is known of what the lens brings into cells, and of the sheet's flatness, by `Evidence`'s names."""
    registration, unfit = table.registration, table.cells.unfit
    known = {"waves_px": registration.lens_residual_px / registration.clearance}
    # A window that is too large sees the neighbours through any lens.
    if table.cells.window <= WINDOW:
        core = bleed(registration.cell_px, registration.blur_px, table.cells.window)
        known["beyond_cell"] = core + table.lens.beyond_cell
    if unfit:
        known["uneven"] = sum(cell.cause.startswith("uneven") for cell in unfit) / len(unfit)
    return known


def _of_spot(table: TableMeasurements, stains: Stains, spot: npt.NDArray[np.int64]) -> Gathered:
    place = _place_of(stains, spot, table.registered_frame.record.file)
    at_mm = np.array([place.x_mm, place.y_mm])
    colour = spot_colour(stains, spot)
    deviation, tint = _colour(colour)
    added, kept = light_of_spot(stains, spot, int(np.argmax(np.abs(colour))))
    size_mm, least = max(place.size_mm, 1e-9), _HALF * abs(deviation)
    hottest = table.dark_frames.hottest
    whites_off = _white_off(table, at_mm, place.size_mm, least)
    white_residual = len(whites_off) / max(len(table.white_frames), 1)
    evidence = Evidence(
        **_across_frames(table, at_mm, size_mm, least),
        white_residual=white_residual,
        some_whites=float(0 < white_residual < 1),
        rim_frames=_dark_rims(table),
        spot=1.0,
        share=len(spot) / len(stains.places_mm),
        deviation=deviation,
        tint=tint,
        added=added,
        kept=kept,
        scatter=table.registered_frame.consistency.scatter,
        softer=0.0,
        hot=float((hottest[spot] > 0).mean()) if len(hottest) == len(stains.places_mm) else np.nan,
    )
    frames: list[FrameMeasurements] = []
    if evidence.in_first == 1:
        frames = [table.registered_frame]
    elif 0 < white_residual <= _HALF:
        frames = whites_off
    elif evidence.even_showing > 0:
        frames = [frame for frame in _showing(table, at_mm, size_mm, least) if frame.record.kind == "white"]
    if frames:
        place = replace(place, file=frames[0].record.file)
    return Gathered(evidence, tuple(frame.record for frame in frames), (place,))


def _white_off(table: TableMeasurements, at_mm: _Array, size_mm: float, least: float) -> list[FrameMeasurements]:
    """Return the white frames whose references are off at a place by `least` or more."""
    reach = max(size_mm, 3 * cell_mm(table.cells.stains))
    return [
        frame
        for frame in table.white_frames
        if abs(_colour(np.array(frame.paper.left.deviation))[0]) >= max(least, _LEAST_RESIDUAL)
        and float(np.linalg.norm(np.array(frame.paper.left.at_mm) - at_mm)) < reach
    ]


def _dark_rims(table: TableMeasurements) -> float:
    """Return the share of the white frames whose corners are darker than their fields; 0 of none."""
    return float(np.mean([frame.paper.left.rim < RIM_OFF for frame in table.white_frames] or [0]))


def _of_residuals(
    table: TableMeasurements, frame: FrameMeasurements
) -> tuple[dict[str, float], tuple[PrintPlace, ...]]:
    """Return what a frame's references show where they deviate most, by the names of `Evidence`, and that place.

    Nothing where the frame is not white, there is no other white one, or they do not deviate.
    """
    whites, left = table.white_frames, frame.paper.left
    deviation, tint = _colour(np.array(left.deviation))
    if frame not in whites or len(whites) < 2 or abs(deviation) < _LEAST_RESIDUAL:
        return {}, ()
    at_mm, near_mm = np.array(left.at_mm), 0.25 * float(np.hypot(*np.ptp(table.cells.stains.places_mm, axis=0)))

    def is_off(other: FrameMeasurements) -> bool:
        seen = other.paper.left
        apart = float(np.linalg.norm(np.array(seen.at_mm) - at_mm))
        return abs(_colour(np.array(seen.deviation))[0]) >= _HALF * abs(deviation) and apart < near_mm

    known = {
        "white_residual": float(np.mean([is_off(other) for other in whites])),
        "deviation": deviation,
        "tint": tint,
        "share": left.share,
        "rim_frames": _dark_rims(table),
    }
    x, y = left.at_mm
    return known, (PrintPlace(frame.record.file, x, y, 0.0),)


def reference_evidence(table: TableMeasurements, limit: float) -> Gathered | None:
    """Return what is known of the references about the flat field, in the white frame with the largest residuals."""
    whites = table.white_frames
    if not whites:
        return None
    worst = max(whites, key=lambda frame: float(frame.paper.spread[int(np.argmax(frame.paper.white))]))
    left, stains = worst.paper.left, table.cells.stains
    known, places = _of_residuals(table, worst)
    known |= {
        "frames": float(len(whites)),
        "rim": left.rim,
        "radial": left.radial,
        "rim_frames": _dark_rims(table),
    }
    if 0 < known.get("white_residual", 0.0) <= _HALF:
        return Gathered(Evidence(**known), (worst.record,), places)
    away = np.linalg.norm(stains.places_mm - left.at_mm, axis=1)
    near = [spot for spot in spots_of(stains) if away[spot].min() < 4 * cell_mm(stains)]
    if not near:
        place = PrintPlace(worst.record.file, *left.at_mm, 0.0)
        return Gathered(Evidence(**known), (), (place,))
    gathered = _of_spot(table, stains, near[0])
    # The spot's colour and light are those of cells of all colours, and known better.
    return replace(gathered, evidence=Evidence(**known | gathered.evidence.known()))


def _across_frames(table: TableMeasurements, at_mm: _Array, size_mm: float, least: float) -> dict[str, float]:
    """Return in which frames a place differs from the frame registered first, by the names of `Evidence`."""
    first = table.registered_frame
    others = [frame for frame in table.frames if frame is not first]
    if not others:
        return {}
    found = _showing(table, at_mm, size_mm, least)
    whites = [frame for frame in others if frame.record.kind == "white"]
    showing = len(found) / len(others)
    return {
        "frames": float(len(others)),
        "showing": showing,
        "even_showing": sum(frame.record.kind == "white" for frame in found) / max(len(whites), 1),
        "in_first": float(showing >= IN_FIRST),
    }


def _showing(table: TableMeasurements, at_mm: _Array, size_mm: float, least: float) -> list[FrameMeasurements]:
    """Return the frames that differ from the one registered first at a place, the worst first."""
    first = table.registered_frame
    found = [
        frame
        for frame in table.frames
        if frame is not first
        and frame.consistency.block >= max(least, LEAST_BLOCK)
        and float(np.linalg.norm(np.array(frame.consistency.at_mm) - at_mm))
        <= max(size_mm, frame.consistency.extent_mm)
    ]
    return sorted(found, key=lambda frame: -frame.consistency.block)


def _colour(colour: _Array) -> tuple[float, float]:
    """Return the deviation of the channel that is off most, and how unlike the channels are, over its size."""
    deviation = float(colour[int(np.argmax(np.abs(colour)))])
    lit = colour[colour != 0]
    return deviation, float(np.ptp(lit)) / max(abs(deviation), 1e-9) if len(lit) > 1 else 0.0


def _place_of(stains: Stains, spot: npt.NDArray[np.int64], file: str) -> PrintPlace:
    x, y = stains.places_mm[spot].mean(axis=0).tolist()
    return PrintPlace(file, x, y, 2 * float(np.sqrt(len(spot) / np.pi)) * cell_mm(stains))


def _spot_share(stains: Stains, at_mm: _Array, size_mm: float) -> float:
    if not stains.known:
        return np.nan
    near = np.linalg.norm(stains.places_mm - at_mm, axis=1) < max(size_mm / 2, 2 * cell_mm(stains))
    return float((stains.stained | stains.doubtful)[near].mean()) if near.any() else np.nan


def _hot_share(table: TableMeasurements, at_mm: _Array, size_mm: float) -> float:
    hottest, places = table.dark_frames.hottest, table.cells.stains.places_mm
    if len(hottest) != len(places):
        return np.nan
    near = np.linalg.norm(places - at_mm, axis=1) < size_mm / 2
    return float((hottest[near] > 0).mean()) if near.any() else np.nan


def scatter_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of the frame whose cells scatter most."""
    worst = max(table.frames, key=lambda frame: frame.consistency.scatter)
    return _of_frames(table, worst, [frame for frame in table.frames if frame.consistency.scatter > limit])


def blur_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of the softest frame."""
    worst = max(table.frames, key=lambda frame: frame.blur_px)
    return _of_frames(table, worst, [frame for frame in table.frames if table.added_bleed(frame) > limit])


def movement_evidence(table: TableMeasurements, limit: float) -> Gathered | None:
    """Return what is known of the frames in which the chart was registered again."""
    anew = [frame for frame in table.frames if frame.reregistered]
    if not anew:
        return None
    return _of_frames(table, max(anew, key=lambda frame: frame.shift.length_px), anew)


def chart_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of the frame in which the chart was registered first."""
    registered = table.registered_frame
    gathered = _of_frames(table, registered, [registered])
    # What lay on the print is seen by its references, where other white frames show them without it.
    known, places = _of_residuals(table, registered)
    return Gathered(Evidence(**gathered.evidence.known() | known), gathered.frames, places)


def _of_frames(table: TableMeasurements, worst: FrameMeasurements, beyond: list[FrameMeasurements]) -> Gathered:
    """Return what is known of a frame as a whole; `beyond` are all frames that show it."""
    frames, ordered = table.frames, sorted(beyond, key=lambda frame: frame is not worst)
    evidence = Evidence(
        frames=float(len(frames)),
        showing=len(beyond) / len(frames),
        scatter=worst.consistency.scatter,
        softer=table.added_bleed(worst),
        moved_px=worst.shift.length_px,
        anew=float(np.mean([frame.reregistered for frame in frames])),
        agreement=table.registration.agreement,
    )
    whole = len(beyond) == len(frames)
    return Gathered(evidence, () if whole else tuple(frame.record for frame in ordered), ())


def light_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of whites that do not add up, drift, or are not what their codes give."""
    frames = table.frames
    evidence = Evidence(frames=float(len(frames)), colour_scatter=_colour_scatter(table))
    stated = np.array([frame.exposure for frame in frames])
    if len(frames) < 2 or not (stated > 0).all():
        return Gathered(evidence, (), ())
    # What most light frames have is the session's; white frames are few.
    ratio = stated / float(np.median([frame.exposure for frame in frames if frame.record.kind == "light"] or stated))
    off = np.abs(np.log(ratio))
    worst = int(np.argmax(off))
    beyond = np.flatnonzero(off > 0.5 * off[worst]) if off[worst] > _SAME else ()
    evidence = replace(evidence, exposure=float(ratio[worst]))
    return Gathered(evidence, tuple(frames[number].record for number in beyond), ())


def drift_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of white frames that differ: their exposures, or what lies on the print in one."""
    light = light_evidence(table, limit)
    worst = max(table.white_frames, key=lambda frame: frame.consistency.block, default=None)
    if worst is None or light.frames or not worst.consistency.block > _DISTURBED:
        return light
    block = _block_of(table, worst, _DISTURBED)
    known = block.evidence.known() | light.evidence.known() | {"frames": block.evidence.frames}
    return Gathered(Evidence(**known), block.frames, block.places)


def sum_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of primaries that do not add up to white: whether it is one of them, and its frame."""
    light, white = light_evidence(table, limit), table.lights.additivity
    if light.frames or white is None:
        return light
    off = white.amounts
    low, middle, high = np.argsort(off).tolist()
    under, over = (float(step) for step in (off[middle] - off[low], off[high] - off[middle]))
    lone, other = max(under, over), min(under, over)
    # What white itself differs by, from one white frame to the next, each primary's frame may have, too.
    if not lone > _MORE * _colour_range(table):
        return light
    if lone > _MORE * other:
        one, known = low if under > over else high, replace(light.evidence, lone_primary=lone)
    elif other > _EQUALLY * lone:
        one, known = high, replace(light.evidence, mixed=lone)
    else:
        return light
    frames = tuple(frame.record for frame in table.frames if frame.record.illumination == table.primary_lights[one])
    return Gathered(known, frames, ())


# How much further one primary lies from the nearer of the others than these from each other, to be alone (chosen).
_MORE = 3.0

# Share of what white has more of one primary that it lacks of another at least, where the first's frame holds the
# other's light (chosen).
_EQUALLY = 0.7


def _colour_range(table: TableMeasurements) -> float:
    """Return by how much white's colour differs between white frames, relative; 0 of one."""
    white = np.log([frame.paper.white for frame in table.white_frames]).reshape(-1, 3)
    return float(np.ptp(white - white.mean(axis=1, keepdims=True), axis=0).max(initial=0.0)) if len(white) else 0.0


def _colour_scatter(table: TableMeasurements) -> float:
    """Return the scatter of white's colour from one white frame to the next, of three or more; else 0.

    Nothing where it drifts rather: where it goes further than it scatters.
    """
    white = np.log([frame.paper.white for frame in table.white_frames]).reshape(-1, 3)
    if len(white) < 3:
        return 0.0
    colour = white[:, [0, 2]] - white[:, [1]]
    bends = colour[1:-1] - (colour[:-2] + colour[2:]) / 2
    scatter = float(np.sqrt((bends**2).mean() / 1.5))
    return scatter if scatter > np.abs(colour[-1] - colour[0]).max() / len(colour) else 0.0


def name_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of lights whose whites are not what their codes give."""
    gathered, codes = light_evidence(table, np.inf), table.lights.codes
    if codes is None:
        return gathered
    exchanged = {light for pair in codes.exchanges for light in (pair.one, pair.other)}
    off = table.lights.off_codes_deg
    far: set[int] = set() if off is None else set(np.flatnonzero(off > limit).tolist())
    as_another = exchanged | {light for light in far if codes.seen_as[light] >= 0}
    lights = table.session.lights
    whites = [frame.record for number, frame in enumerate(table.white_frames) if lights + number in exchanged]
    named = [frame.record for frame in table.frames if frame.record.illumination in far | exchanged]
    evidence = replace(gathered.evidence, off_codes_deg=float(codes.off_deg.max()))
    if as_another:
        evidence = replace(evidence, named_right=0.0)
    return Gathered(evidence, (*named, *whites), ())


def brightness_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of lights that are brighter or darker than their codes give."""
    gathered, codes = light_evidence(table, limit), table.lights.codes
    if gathered.frames or codes is None:
        return gathered
    off = set(np.flatnonzero(codes.off_brightness > limit).tolist())
    frames = tuple(frame.record for frame in table.frames if frame.record.illumination in off)
    return Gathered(gathered.evidence, frames, ())


def camera_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of frames of another camera or lens."""
    origins = table.origins
    foreign = origins.other_camera or origins.other_lens
    cameras = 1 + len({frame.found for frame in foreign})
    evidence = Evidence(frames=float(len(table.frames)), cameras=float(cameras))
    return Gathered(evidence, tuple(frame.record for frame in foreign), ())


def iso_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return which frames state another ISO speed."""
    frames = tuple(frame.record for frame in table.origins.other_iso)
    return Gathered(Evidence(frames=float(len(table.frames)), other_iso=float(len(frames))), frames, ())


def dark_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of the light while the projector shows black."""
    frames = float(len(table.dark_frames.files))
    return Gathered(Evidence(frames=frames, room=table.dark_share, room_change=table.dark_change), (), ())


def stray_evidence(table: TableMeasurements, limit: float) -> Gathered:
    """Return what is known of light that no dark frame shows, and in which frames."""
    stray = table.lights.stray
    if stray is None:
        return Gathered(Evidence(), (), ())
    mixed = sum_evidence(table, limit)
    if mixed.evidence.mixed > limit:
        return mixed
    by_light = {frame.record.illumination: frame.record for frame in table.frames if frame.record.kind == "light"}
    frames = tuple(by_light[light] for light in stray.lights_beyond(limit) if light in by_light)
    certain = float(stray.certain.max(initial=0.0))
    evidence = Evidence(frames=float(len(table.frames)), stray=certain, stray_primaries=stray.of_primaries)
    return Gathered(evidence, frames, ())
