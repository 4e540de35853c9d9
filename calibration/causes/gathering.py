"""Gather the evidence for the cause of a figure beyond its limit.

Each public function with a name `…_evidence` takes the measurements of a LUT and the accepted limit. It returns a
`CauseEvidence`, or None if there is no evidence. The functions for positions on the print are first, then the functions
for whole frames, then the functions for illuminants.
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

# Smallest relative deviation of a block of patches that is a fault. Simulated frames without faults have less.
MIN_BLOCK = 0.004

# Another frame shows the same fault if its deviation is at least this fraction of the worst frame's deviation.
SAME_FAULT = 0.3

MAX_POSITIONS = 12  # Largest number of positions per figure; more marks would cover the plotted image

# If at least this fraction of frames differs at a position from the frame registered first, that frame is faulty.
IN_FIRST = 0.8

# Another frame shows the same spot if it deviates by at least this fraction of the deviation of the spot. If at most
# this fraction of the white frames shows the spot, these frames are faulty, and not the print.
_SAME_SPOT = 0.5

# Smallest relative residual of references for which an object is reported: ten times their noise under white.
_MIN_RESIDUAL = 0.02

# Mean relative residual of the outermost references below which a frame's corners are darker than its flat field.
DARK_RIM = -0.005

# Smallest number of adjacent patches that proves added light, if all are brighter.
_MIN_BRIGHT = 4

# A thin shadow darkens at least this fraction of the patches on which it falls. Chosen by judgement.
_MIN_DARK_FRACTION = 0.8

# Smallest deviation that proves an object if fewer patches than `_MIN_DARK_FRACTION` are darker. A hand and a printed
# colour rarely differ less. Chosen by judgement.
_MIN_COVERED_DEVIATION = 0.1

# If at least this fraction of the noisy patches is in spots of the print, the spots explain the noise.
_MIN_SPOT_FRACTION = 0.5

# Smallest deviation of a block from which an object also changes the mean of the references. Chosen by judgement.
_MIN_DISTURBED_BLOCK = 0.03

# Exposures are equal if the logarithm of their ratio is smaller. Shutter times have steps of 26 %, and files contain
# rounded times.
_SAME_EXPOSURE = 0.03

_Array = npt.NDArray[np.float64]
_Frames = list[FrameMeasurements]


@dataclass(frozen=True)
class PrintPosition:
    """A position on the print."""

    file: str  # File of the frame that shows the position best
    x_mm: float  # Centre, from the sheet's top-left corner
    y_mm: float
    size_mm: float  # Diameter; 0 for a single patch


@dataclass(frozen=True)
class CauseEvidence:
    """Evidence for a figure's cause, and the frames and positions that show it."""

    evidence: Evidence
    frames: tuple[FrameRecord, ...]
    positions: tuple[PrintPosition, ...]


def block_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on the block with the largest deviation from the frame registered first, over all frames."""
    return _gather_block(table, max(table.frames, key=lambda frame: frame.consistency.block), limit)


def _gather_block(table: TableMeasurements, worst: FrameMeasurements, limit: float) -> CauseEvidence:
    consistency = worst.consistency
    at_mm, size_mm = np.array(consistency.at_mm), max(consistency.extent_mm, 1e-9)
    deviation, tint = _largest_deviation(np.array(consistency.colour))
    evidence = Evidence(
        **_frame_evidence(table, at_mm, size_mm, SAME_FAULT * consistency.block),
        spot=_spot_fraction(table.cells.stains, at_mm, size_mm),
        share=consistency.share,
        deviation=deviation,
        tint=tint,
        added=consistency.added,
        kept=consistency.kept,
        scatter=consistency.scatter,
        softer=table.added_bleed(worst),
        hot=_hot_fraction(table, at_mm, size_mm),
        moved_px=worst.shift.length_px,
    )
    in_first = evidence.in_first == 1
    beyond = [frame for frame in table.frames if frame.consistency.block > limit] or [worst]
    frames = [table.registered_frame] if in_first else sorted(beyond, key=lambda frame: -frame.consistency.block)
    x, y = consistency.at_mm
    if in_first and (object_positions := _residual_evidence(table, table.registered_frame)[1]):
        # The patches under the object were not compared, because they did not match the chart. The white references
        # show the position of the object.
        x, y = object_positions[0].x_mm, object_positions[0].y_mm
    position = PrintPosition(frames[0].record.file, x, y, size_mm)
    return CauseEvidence(evidence, tuple(frame.record for frame in frames), (position,))


def covered_deviation(deviations: npt.NDArray[np.float64]) -> float:
    """Return the deviation of adjacent patches if an object may cover them; else NaN.

    `deviations`: (N,) float64, relative, with sign; 0 if unknown.
    """
    known_deviations = deviations[deviations != 0]
    darker = known_deviations[known_deviations < 0]
    if not len(darker):
        # A few brighter patches may be dark patches that a hand covers.
        return float(np.median(known_deviations)) if len(known_deviations) >= _MIN_BRIGHT else np.nan
    # Blur also mixes neighbouring patches. It changes patches slightly, and makes as many brighter as darker.
    is_mixed = (
        len(darker) < _MIN_DARK_FRACTION * len(known_deviations)
        and np.abs(known_deviations).max() < _MIN_COVERED_DEVIATION
    )
    return np.nan if is_mixed else float(darker.min())


def disturbed_evidence(table: TableMeasurements, limit: float) -> CauseEvidence | None:
    """Gather evidence on the patches that a small object covers in illuminants' frames; None if there are none."""
    worst = max(table.frames, key=lambda frame: len(frame.consistency.disturbed))
    return _gather_disturbed(table, table.added_bleed(worst))


def _gather_disturbed(table: TableMeasurements, softer: float) -> CauseEvidence | None:
    # `softer`: fraction of light of neighbouring patches that the worst frame's blur adds.
    lights = [frame for frame in table.frames if frame.record.kind == "light" and frame.consistency.disturbed]
    if not lights:
        return None
    lights.sort(key=lambda frame: -len(frame.consistency.disturbed))
    worst, stains, first = lights[0], table.cells.stains, table.registered_frame
    cells = np.array([cell for cell, _ in worst.consistency.disturbed], dtype=np.int64)
    deviations = np.array([deviation for _, deviation in worst.consistency.disturbed])
    other_frames = [frame for frame in table.frames if frame is not first]
    whites = [frame for frame in other_frames if frame.record.kind == "white"]

    def showing(frames: list[FrameMeasurements]) -> float:
        shows = [any(cell in cells for cell, _ in frame.consistency.disturbed) for frame in frames]
        return sum(shows) / max(len(frames), 1)

    deviation = covered_deviation(deviations)
    evidence = Evidence(
        frames=float(len(other_frames)),
        showing=showing(other_frames),
        even_showing=showing(whites),
        in_first=float(showing(other_frames) >= IN_FIRST),
        spot=float((stains.stained | stains.doubtful)[cells].mean()) if stains.is_known else np.nan,
        share=len(cells) / len(stains.places_mm),
        deviation=deviation,
        scatter=worst.consistency.scatter,
        softer=softer,
    )
    positions: list[PrintPosition] = []
    for frame in lights[:MAX_POSITIONS]:
        frame_cells = np.array([cell for cell, _ in frame.consistency.disturbed], dtype=np.int64)
        positions += [_position_of(stains, spot, frame.record.file) for spot in joined_cells(stains, frame_cells)]
    return CauseEvidence(evidence, tuple(frame.record for frame in lights), tuple(positions[:MAX_POSITIONS]))


def spot_evidence(table: TableMeasurements, limit: float) -> CauseEvidence | None:
    """Gather evidence on the largest spot (area with wrong colours) of the print; None if there is no spot."""
    stains = table.cells.stains
    spots = spots_of(stains)
    if not spots:
        return None
    gathered = _gather_spot(table, stains, spots[0])
    file = gathered.positions[0].file
    other_positions = tuple(_position_of(stains, spot, file) for spot in spots[1:MAX_POSITIONS])
    return replace(gathered, positions=(*gathered.positions, *other_positions))


def unfit_evidence(table: TableMeasurements, limit: float) -> CauseEvidence | None:
    """Gather evidence on the unfit patches of the most frequent kind."""
    kinds = [cell.kind for cell in table.cells.unfit]
    common = max(dict.fromkeys(kinds), key=kinds.count, default="stained")
    if common == "stained":
        return spot_evidence(table, limit)
    stains, registered = table.cells.stains, table.registered_frame.record
    colours = np.array([cell.colour for cell in table.cells.unfit], dtype=np.int64)
    hot = kinds.count("hot") / len(kinds) if table.dark_frames.files else np.nan
    points = stains.places_mm[colours[[kind == common for kind in kinds]]][:MAX_POSITIONS].tolist()
    positions = tuple(PrintPosition(registered.file, x, y, 0.0) for x, y in points)
    if common == "disturbed" and (covered := _gather_disturbed(table, 0.0)) is not None:
        return covered
    if common != "covered":
        evidence = _lens_evidence(table) | {
            "misplaced": kinds.count("misplaced") / len(kinds),
            "hot": hot,
            "lit": kinds.count("lit") / len(kinds),
        }
        return CauseEvidence(Evidence(**evidence), (), positions)
    evidence, covering = _residual_evidence(table, table.registered_frame)
    return CauseEvidence(Evidence(**evidence | {"hot": hot}), (registered,) if evidence else (), covering or positions)


def noisy_evidence(table: TableMeasurements, limit: float) -> CauseEvidence | None:
    """Gather evidence on patches that are noisier than expected for their level."""
    noisy_cells, stains = np.flatnonzero(table.sensor.transfer.noisy), table.cells.stains
    is_in_spot = stains.stained | stains.doubtful
    if len(noisy_cells) and stains.is_known and float(is_in_spot[noisy_cells].mean()) >= _MIN_SPOT_FRACTION:
        return spot_evidence(table, limit)
    gathered = chart_evidence(table, limit)
    hottest = table.dark_frames.hottest
    hot = float((hottest[noisy_cells] > 0).mean()) if len(hottest) and len(noisy_cells) else np.nan
    file = table.registered_frame.record.file
    positions = tuple(PrintPosition(file, x, y, 0.0) for x, y in stains.places_mm[noisy_cells[:MAX_POSITIONS]].tolist())
    evidence = gathered.evidence.measured_values()
    frames = gathered.frames if "white_residual" in evidence else ()
    return CauseEvidence(Evidence(**evidence | _lens_evidence(table) | {"hot": hot}), frames, positions)


def _lens_evidence(table: TableMeasurements) -> dict[str, float]:
    """Return evidence on light from outside the patches and on the flatness of the sheet, by names of `Evidence`."""
    registration, unfit = table.registration, table.cells.unfit
    evidence = {"waves_px": registration.lens_residual_px / registration.clearance}
    # A window that is too large contains light of neighbouring patches with any lens.
    if table.cells.window <= WINDOW:
        window_bleed = bleed(registration.cell_px, registration.blur_px, table.cells.window)
        evidence["beyond_cell"] = window_bleed + table.lens.beyond_cell
    if unfit:
        evidence["uneven"] = sum(cell.cause.startswith("uneven") for cell in unfit) / len(unfit)
    return evidence


def _gather_spot(table: TableMeasurements, stains: Stains, spot: npt.NDArray[np.int64]) -> CauseEvidence:
    position = _position_of(stains, spot, table.registered_frame.record.file)
    at_mm = np.array([position.x_mm, position.y_mm])
    colour = spot_colour(stains, spot)
    deviation, tint = _largest_deviation(colour)
    added, kept = light_of_spot(stains, spot, int(np.argmax(np.abs(colour))))
    size_mm, min_deviation = max(position.size_mm, 1e-9), _SAME_SPOT * abs(deviation)
    hottest = table.dark_frames.hottest
    deviating_whites = _faulty_whites(table, at_mm, position.size_mm, min_deviation)
    white_residual = len(deviating_whites) / max(len(table.white_frames), 1)
    evidence = Evidence(
        **_frame_evidence(table, at_mm, size_mm, min_deviation),
        white_residual=white_residual,
        some_whites=float(0 < white_residual < 1),
        rim_frames=_dark_rim_fraction(table),
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
    elif 0 < white_residual <= _SAME_SPOT:
        frames = deviating_whites
    elif evidence.even_showing > 0:
        frames = _faulty_frames(table, at_mm, size_mm, min_deviation)
        frames = [frame for frame in frames if frame.record.kind == "white"]
    if frames:
        position = replace(position, file=frames[0].record.file)
    return CauseEvidence(evidence, tuple(frame.record for frame in frames), (position,))


def _faulty_whites(table: TableMeasurements, at_mm: _Array, size_mm: float, minimum: float) -> list[FrameMeasurements]:
    reach = max(size_mm, 3 * cell_mm(table.cells.stains))
    return [
        frame
        for frame in table.white_frames
        if abs(_largest_deviation(np.array(frame.paper.left.deviation))[0]) >= max(minimum, _MIN_RESIDUAL)
        and float(np.linalg.norm(np.array(frame.paper.left.at_mm) - at_mm)) < reach
    ]


def _dark_rim_fraction(table: TableMeasurements) -> float:
    return float(np.mean([frame.paper.left.rim < DARK_RIM for frame in table.white_frames] or [0]))


def _residual_evidence(
    table: TableMeasurements, frame: FrameMeasurements
) -> tuple[dict[str, float], tuple[PrintPosition, ...]]:
    """Return evidence on the largest residual of the references in a white frame, and its position on the print.

    Both are empty if the residual is small or if there is no other white frame.
    """
    whites, residuals = table.white_frames, frame.paper.left
    deviation, tint = _largest_deviation(np.array(residuals.deviation))
    if frame not in whites or len(whites) < 2 or abs(deviation) < _MIN_RESIDUAL:
        return {}, ()
    at_mm, near_mm = np.array(residuals.at_mm), 0.25 * float(np.hypot(*np.ptp(table.cells.stains.places_mm, axis=0)))

    def deviates_too(frame: FrameMeasurements) -> bool:
        other = frame.paper.left
        distance_mm = float(np.linalg.norm(np.array(other.at_mm) - at_mm))
        largest, _ = _largest_deviation(np.array(other.deviation))
        return abs(largest) >= _SAME_SPOT * abs(deviation) and distance_mm < near_mm

    evidence = {
        "white_residual": float(np.mean([deviates_too(white) for white in whites])),
        "deviation": deviation,
        "tint": tint,
        "share": residuals.share,
        "rim_frames": _dark_rim_fraction(table),
    }
    x, y = residuals.at_mm
    return evidence, (PrintPosition(frame.record.file, x, y, 0.0),)


def reference_evidence(table: TableMeasurements, limit: float) -> CauseEvidence | None:
    """Gather evidence on the white frame with the largest residuals of references about the flat field."""
    whites = table.white_frames
    if not whites:
        return None
    worst = max(whites, key=lambda frame: float(frame.paper.spread[int(np.argmax(frame.paper.white))]))
    residuals, stains = worst.paper.left, table.cells.stains
    evidence, positions = _residual_evidence(table, worst)
    evidence |= {
        "frames": float(len(whites)),
        "rim": residuals.rim,
        "radial": residuals.radial,
        "rim_frames": _dark_rim_fraction(table),
    }
    if 0 < evidence.get("white_residual", 0.0) <= _SAME_SPOT:
        return CauseEvidence(Evidence(**evidence), (worst.record,), positions)
    distance_mm = np.linalg.norm(stains.places_mm - residuals.at_mm, axis=1)
    near_spots = [spot for spot in spots_of(stains) if distance_mm[spot].min() < 4 * cell_mm(stains)]
    if not near_spots:
        position = PrintPosition(worst.record.file, *residuals.at_mm, 0.0)
        return CauseEvidence(Evidence(**evidence), (), (position,))
    gathered = _gather_spot(table, stains, near_spots[0])
    # The spot was measured with patches of all colours, which is more accurate than with references alone.
    return replace(gathered, evidence=Evidence(**evidence | gathered.evidence.measured_values()))


def _frame_evidence(table: TableMeasurements, at_mm: _Array, size_mm: float, min_deviation: float) -> dict[str, float]:
    """Return evidence on frames that deviate at a position from the frame registered first, by names of `Evidence`."""
    first = table.registered_frame
    other_frames = [frame for frame in table.frames if frame is not first]
    if not other_frames:
        return {}
    deviating_frames = _faulty_frames(table, at_mm, size_mm, min_deviation)
    whites = [frame for frame in other_frames if frame.record.kind == "white"]
    showing = len(deviating_frames) / len(other_frames)
    return {
        "frames": float(len(other_frames)),
        "showing": showing,
        "even_showing": sum(frame.record.kind == "white" for frame in deviating_frames) / max(len(whites), 1),
        "in_first": float(showing >= IN_FIRST),
    }


def _faulty_frames(table: TableMeasurements, at_mm: _Array, size_mm: float, minimum: float) -> list[FrameMeasurements]:
    """Return the frames that deviate at a position from the frame registered first, worst first."""
    first = table.registered_frame
    frames = [
        frame
        for frame in table.frames
        if frame is not first
        and frame.consistency.block >= max(minimum, MIN_BLOCK)
        and float(np.linalg.norm(np.array(frame.consistency.at_mm) - at_mm))
        <= max(size_mm, frame.consistency.extent_mm)
    ]
    return sorted(frames, key=lambda frame: -frame.consistency.block)


def _largest_deviation(colour: _Array) -> tuple[float, float]:
    """Return the largest deviation of a channel and the relative range of the channels; channels at 0 are unknown."""
    deviation = float(colour[int(np.argmax(np.abs(colour)))])
    known = colour[colour != 0]
    return deviation, float(np.ptp(known)) / max(abs(deviation), 1e-9) if len(known) > 1 else 0.0


def _position_of(stains: Stains, spot: npt.NDArray[np.int64], file: str) -> PrintPosition:
    x, y = stains.places_mm[spot].mean(axis=0).tolist()
    return PrintPosition(file, x, y, 2 * float(np.sqrt(len(spot) / np.pi)) * cell_mm(stains))


def _spot_fraction(stains: Stains, at_mm: _Array, size_mm: float) -> float:
    if not stains.is_known:
        return np.nan
    near = np.linalg.norm(stains.places_mm - at_mm, axis=1) < max(size_mm / 2, 2 * cell_mm(stains))
    return float((stains.stained | stains.doubtful)[near].mean()) if near.any() else np.nan


def _hot_fraction(table: TableMeasurements, at_mm: _Array, size_mm: float) -> float:
    hottest, positions = table.dark_frames.hottest, table.cells.stains.places_mm
    if len(hottest) != len(positions):
        return np.nan
    near = np.linalg.norm(positions - at_mm, axis=1) < size_mm / 2
    return float((hottest[near] > 0).mean()) if near.any() else np.nan


def scatter_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on the frame with the largest scatter of patches."""
    worst = max(table.frames, key=lambda frame: frame.consistency.scatter)
    return _gather_frames(table, worst, [frame for frame in table.frames if frame.consistency.scatter > limit])


def blur_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on the most blurred frame."""
    worst = max(table.frames, key=lambda frame: frame.blur_px)
    return _gather_frames(table, worst, [frame for frame in table.frames if table.added_bleed(frame) > limit])


def movement_evidence(table: TableMeasurements, limit: float) -> CauseEvidence | None:
    """Gather evidence on the frames in which the chart was registered again."""
    registered_again = [frame for frame in table.frames if frame.reregistered]
    if not registered_again:
        return None
    return _gather_frames(table, max(registered_again, key=lambda frame: frame.shift.length_px), registered_again)


def chart_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on the frame in which the chart was registered first."""
    registered = table.registered_frame
    gathered = _gather_frames(table, registered, [registered])
    # References reveal an object on the print only by comparison with other white frames.
    evidence, positions = _residual_evidence(table, registered)
    return CauseEvidence(Evidence(**gathered.evidence.measured_values() | evidence), gathered.frames, positions)


def _gather_frames(table: TableMeasurements, worst: FrameMeasurements, beyond: _Frames) -> CauseEvidence:
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
    affects_all = len(beyond) == len(frames)
    return CauseEvidence(evidence, () if affects_all else tuple(frame.record for frame in ordered), ())


def light_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on the brightness of frames: recorded exposures, and scatter of white's colour."""
    frames = table.frames
    evidence = Evidence(frames=float(len(frames)), colour_scatter=_colour_scatter(table))
    exposures = np.array([frame.exposure for frame in frames])
    if len(frames) < 2 or not (exposures > 0).all():
        return CauseEvidence(evidence, (), ())
    # The usual exposure is the median over the frames of illuminants, because there are few white frames.
    light_exposures = [frame.exposure for frame in frames if frame.record.kind == "light"]
    ratio = exposures / float(np.median(light_exposures or exposures))
    log_ratio = np.abs(np.log(ratio))
    worst = int(np.argmax(log_ratio))
    deviating_frames = np.flatnonzero(log_ratio > 0.5 * log_ratio[worst]) if log_ratio[worst] > _SAME_EXPOSURE else ()
    evidence = replace(evidence, exposure=float(ratio[worst]))
    return CauseEvidence(evidence, tuple(frames[number].record for number in deviating_frames), ())


def drift_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on differences between white frames: other exposures, or an object on the print in one frame."""
    light = light_evidence(table, limit)
    worst = max(table.white_frames, key=lambda frame: frame.consistency.block, default=None)
    if worst is None or light.frames or not worst.consistency.block > _MIN_DISTURBED_BLOCK:
        return light
    block = _gather_block(table, worst, _MIN_DISTURBED_BLOCK)
    evidence = block.evidence.measured_values() | light.evidence.measured_values() | {"frames": block.evidence.frames}
    return CauseEvidence(Evidence(**evidence), block.frames, block.positions)


def sum_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on primaries that do not add up to white, and on the frame of the faulty primary."""
    light, white = light_evidence(table, limit), table.lights.additivity
    if light.frames or white is None:
        return light
    amounts = white.amounts
    low, middle, high = np.argsort(amounts).tolist()
    lower_step, upper_step = (float(step) for step in (amounts[middle] - amounts[low], amounts[high] - amounts[middle]))
    larger_step, smaller_step = max(lower_step, upper_step), min(lower_step, upper_step)
    # Smaller differences may be the usual variation between frames.
    if not larger_step > _LONE_RATIO * _colour_range(table):
        return light
    if larger_step > _LONE_RATIO * smaller_step:
        primary, evidence = low if lower_step > upper_step else high, replace(light.evidence, lone_primary=larger_step)
    elif smaller_step > _MIN_SIMILARITY * larger_step:
        primary, evidence = high, replace(light.evidence, mixed=larger_step)
    else:
        return light
    frames = tuple(frame.record for frame in table.frames if frame.record.illumination == table.primary_lights[primary])
    return CauseEvidence(evidence, frames, ())


# The amounts of the primaries in white differ significantly if their difference exceeds this factor times the range of
# the colour of white frames. One primary is faulty if its difference from the next one is this factor times the
# difference of the other two. Chosen by judgement.
_LONE_RATIO = 3.0

# If the frame of one primary contains another illuminant, white has an excess of one primary and a similar deficit of
# another. This is the smallest ratio of the smaller to the larger of them. Chosen by judgement.
_MIN_SIMILARITY = 0.7


def _colour_range(table: TableMeasurements) -> float:
    white = np.log([frame.paper.white for frame in table.white_frames]).reshape(-1, 3)
    return float(np.ptp(white - white.mean(axis=1, keepdims=True), axis=0).max(initial=0.0)) if len(white) else 0.0


def _colour_scatter(table: TableMeasurements) -> float:
    # The result is 0 if the colour of white drifts more than it scatters between frames.
    log_white = np.log([frame.paper.white for frame in table.white_frames]).reshape(-1, 3)
    if len(log_white) < 3:
        return 0.0
    colour = log_white[:, [0, 2]] - log_white[:, [1]]
    bends = colour[1:-1] - (colour[:-2] + colour[2:]) / 2
    scatter = float(np.sqrt((bends**2).mean() / 1.5))
    return scatter if scatter > np.abs(colour[-1] - colour[0]).max() / len(colour) else 0.0


def name_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on illuminants that do not fit their codes."""
    gathered, codes = light_evidence(table, np.inf), table.lights.codes
    if codes is None:
        return gathered
    exchanged = {light for pair in codes.exchanges for light in (pair.one, pair.other)}
    angle_deg = table.lights.off_codes_deg
    far_lights: set[int] = set() if angle_deg is None else set(np.flatnonzero(angle_deg > limit).tolist())
    confused = exchanged | {light for light in far_lights if codes.seen_as[light] >= 0}
    lights = table.session.lights
    white_records = [frame.record for number, frame in enumerate(table.white_frames) if lights + number in exchanged]
    light_records = [frame.record for frame in table.frames if frame.record.illumination in far_lights | exchanged]
    evidence = replace(gathered.evidence, off_codes_deg=float(codes.off_deg.max()))
    if confused:
        evidence = replace(evidence, named_right=0.0)
    return CauseEvidence(evidence, (*light_records, *white_records), ())


def brightness_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on illuminants that are brighter or darker than predicted from their codes."""
    gathered, codes = light_evidence(table, limit), table.lights.codes
    if gathered.frames or codes is None:
        return gathered
    deviating_lights = set(np.flatnonzero(codes.off_brightness > limit).tolist())
    frames = tuple(frame.record for frame in table.frames if frame.record.illumination in deviating_lights)
    return CauseEvidence(gathered.evidence, frames, ())


def camera_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on frames of another camera or lens."""
    origins = table.origins
    foreign_frames = origins.other_camera or origins.other_lens
    cameras = 1 + len({frame.found for frame in foreign_frames})
    evidence = Evidence(frames=float(len(table.frames)), cameras=float(cameras))
    return CauseEvidence(evidence, tuple(frame.record for frame in foreign_frames), ())


def iso_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on frames of another ISO speed."""
    frames = tuple(frame.record for frame in table.origins.other_iso)
    return CauseEvidence(Evidence(frames=float(len(table.frames)), other_iso=float(len(frames))), frames, ())


def dark_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on the light while the projector shows black."""
    frames = float(len(table.dark_frames.files))
    return CauseEvidence(Evidence(frames=frames, room=table.dark_share, room_change=table.dark_change), (), ())


def stray_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    """Gather evidence on light that is in some frames but not in the dark frames."""
    stray = table.lights.stray
    if stray is None:
        return CauseEvidence(Evidence(), (), ())
    mixed = sum_evidence(table, limit)
    if mixed.evidence.mixed > limit:
        return mixed
    by_light = {frame.record.illumination: frame.record for frame in table.frames if frame.record.kind == "light"}
    frames = tuple(by_light[light] for light in stray.lights_beyond(limit) if light in by_light)
    certain = float(stray.certain.max(initial=0.0))
    evidence = Evidence(frames=float(len(table.frames)), stray=certain, stray_primaries=stray.of_primaries)
    return CauseEvidence(evidence, frames, ())
