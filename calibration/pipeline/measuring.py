"""What one frame shows: how the chart has moved, its paper and greys, its samples.

Rules that hold inside:

- A frame is measured with the baseline, the frame registered last, and the dark light, and with nothing else, so that
  frames can be measured in any order and by any thread.
- The chart must lie where it was registered: a movement up to a tenth of a pixel is neglected, up to half a pixel the
  sampling grid is moved along, and beyond it the chart is registered again in that frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calibration.measurements import FrameMeasurements
from calibration.pipeline.baseline import Baseline, DecodedFrame, RegisteredFrame, beyond_print, sites_of, usable_means
from calibration.radiometry.dark_frames import DarkFrameFigures, DarkLight, measure_dark_frame, winsorised_means
from calibration.radiometry.primaries import Primaries
from calibration.sampling import (
    gather,
    gather_means,
    gather_values,
    patch_means,
    sample_noise,
    table_values,
)
from calibration.spread.surroundings import FrameLevels
from experiment.framing.pictures import REREGISTER_PX, STILL_PX, Shift, gauges_of, shift_between
from experiment.measures.paper import Paper
from foundation.errors import RegistrationError

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeasuredFrame:
    """A light or white frame as measured; C cells of S samples.

    - `figures`: for the report, the ground truth and the flat field.
    - `registered`: the frame registered last, with which it was measured.
    - `saturation`: raw count of saturation, as far as it can be seen in this frame.
    - `values`: (C, S, 3) uint16, the table's samples.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `inside`: (C,) bool, whether all pixels of a cell lie in the frame.
    - `samples`, `noise`: (C, S, 3) float32 counts above black and (C, 3) float64 counts, their noise; None where not
      asked for.
    """

    figures: FrameMeasurements
    registered: RegisteredFrame
    saturation: int
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    inside: npt.NDArray[np.bool_]
    samples: npt.NDArray[np.float32] | None
    noise: _Array | None


@dataclass(frozen=True, eq=False)
class MeasuredDarkFrame:
    """A dark frame as measured; C cells of S samples.

    - `figures`: what it shows.
    - `registered`: the frame registered last, with which it was measured.
    - `excess`: (C, S, 3) int16 counts, how far samples stand above their cells.
    - `means`: (C + W + N, 3) float64 counts above black of cells, then references.
    """

    figures: DarkFrameFigures
    registered: RegisteredFrame
    excess: npt.NDArray[np.int16]
    means: _Array


def measure_frame(
    baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame, keep_samples: bool, dark: DarkLight | None
) -> MeasuredFrame | Shift:
    """Return what a frame shows; its movement alone, if that is such that the chart has to be registered again.

    `dark`: what is subtracted from samples and references; nothing if None.
    """
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    channel, framing = decoded.strongest, registered.registration.framing
    gauges = gauges_of(decoded.mosaic, channel, decoded.black, framing)
    shift = shift_between(registered.gauges[channel], framing, gauges)
    # A turn or a change of distance moves the tags differently; moving the grid along would not help.
    turned = shift.largest_px > shift.length_px + STILL_PX
    if shift.gauges == 0 or shift.length_px > REREGISTER_PX or turned:
        return shift
    at = registered
    if shift.length_px > STILL_PX:
        moved = registered.registration.shifted(shift.dx, shift.dy)
        shape = decoded.mosaic.block_planes().shape[2:]
        cells, references = sites_of(moved, baseline.points, shape, baseline.options.window)
        lens = baseline.correction(moved, cells, references)
        at = replace(registered, cells=cells, references=references, lens=lens)
    return _measured(baseline, decoded, at, shift, False, keep_samples, dark, registered)


def measure_registered_frame(
    baseline: Baseline,
    decoded: DecodedFrame,
    registered: RegisteredFrame,
    shift: Shift,
    keep_samples: bool,
    dark: DarkLight | None = None,
) -> MeasuredFrame:
    """Return what a frame shows in which the chart was registered, `shift` px from the frame registered before.

    Parameters and errors are otherwise those of `measure_frame`.
    """
    again = registered is not baseline.first
    return _measured(baseline, decoded, registered, shift, again, keep_samples, dark, registered)


def sample_dark_frame(baseline: Baseline, decoded: DecodedFrame, registered: RegisteredFrame) -> MeasuredDarkFrame:
    """Return what a dark frame shows; no tag is seen in it, so the chart is assumed to lie where it did."""
    baseline.require_layout(decoded.mosaic, decoded.record.file)
    cells, _ = gather(decoded.mosaic, decoded.black, registered.cells)
    references, _ = gather(decoded.mosaic, decoded.black, registered.references)
    whites_mm = baseline.points.whites_mm
    whites = np.flatnonzero(registered.references.inside[: len(whites_mm)])
    shape = baseline.paper.base.at(whites_mm)[whites]
    figures, excess = measure_dark_frame(decoded.record, decoded.black, cells, references[whites], shape)
    means = np.concatenate([winsorised_means(patches, figures.noise) for patches in (cells, references)])
    return MeasuredDarkFrame(replace(figures, origin=decoded.mosaic.origin), registered, excess, means)


def measure_primaries(baseline: Baseline, frames: Iterable[DecodedFrame]) -> Primaries | None:
    """Return what the frames of red, green and blue alone show; None where there are none or one cannot be used.

    The chart may lie elsewhere in them; `frames` are read once, one at a time.
    """
    lights: list[int] = []
    papers: list[Paper] = []
    cells: list[_Array] = []
    for decoded in frames:
        measured = measure_frame(baseline, decoded, baseline.first, keep_samples=False, dark=None)
        if isinstance(measured, Shift):
            try:
                registered = baseline.register(decoded)
            except RegistrationError:
                return None
            measured = measure_registered_frame(baseline, decoded, registered, measured, keep_samples=False)
        light = decoded.record.illumination
        assert light is not None
        lights.append(light)
        papers.append(measured.figures.paper)
        cells.append(patch_means(measured.values))
    return Primaries.of(lights, papers, cells, baseline.points.cells_mm) if lights else None


def movement_of(baseline: Baseline, before: RegisteredFrame, after: RegisteredFrame) -> Shift:
    """Return how far the cells have moved from one registered frame to another, however far that is."""
    cells_mm = baseline.points.cells_mm
    by = after.registration.to_pixels(cells_mm) - before.registration.to_pixels(cells_mm)
    dx, dy = np.median(by, axis=0).tolist()
    return Shift(dx, dy, float(np.linalg.norm(by, axis=1).max()), len(by))


def _measured(
    baseline: Baseline,
    decoded: DecodedFrame,
    at: RegisteredFrame,
    shift: Shift,
    reregistered: bool,
    keep_samples: bool,
    dark: DarkLight | None,
    registered: RegisteredFrame,
) -> MeasuredFrame:
    """Return what a frame shows that is sampled `at` these places."""
    points = baseline.points
    samples, highest = gather(decoded.mosaic, decoded.black, at.references)
    seen = usable_means(samples, highest, at.references, decoded.saturation)
    to_subtract = _to_subtract(decoded, at, samples, dark)
    of_cells = None
    if to_subtract is not None:
        of_cells, of_references = np.split(to_subtract, [len(points.cells_mm)])
        seen -= of_references
    whites, greys = np.split(seen, [len(points.whites_mm)])
    paper, shape = baseline.paper.read(whites, decoded.record.file)
    if baseline.primaries is not None:
        shape = shape * baseline.primaries.field_ratio(paper.white)
    grey_values, grey_errors = points.levels.read(greys, paper.field.at(points.greys_mm))
    if keep_samples:
        kept, highest = gather(decoded.mosaic, decoded.black, at.cells)
        values, noise = table_values(kept, shape, of_cells), sample_noise(kept)
        if of_cells is not None and dark is None:
            kept -= of_cells[:, None]
        elif of_cells is not None and dark is not None:
            kept -= (of_cells - dark.patches[: len(of_cells)])[:, None]
    else:
        values, highest = gather_values(decoded.mosaic, decoded.black, at.cells, shape, of_cells)
        kept = noise = None
    # σ of the registered frame's blur, and what the gauges are softer than in it.
    blur_growth_px2 = 0.0 if reregistered else shift.blur_growth_px2
    mean = patch_means(values)
    variance = baseline.transfer.variance(mean) / baseline.options.samples
    figures = FrameMeasurements(
        record=decoded.record,
        black=decoded.black,
        channel=decoded.strongest,
        shift=shift,
        reregistered=reregistered,
        paper=paper,
        consistency=baseline.consistency_check.compare(mean, variance),
        greys=grey_values,
        grey_errors=grey_errors,
        dark=np.zeros(3) if dark is None else dark.paper,
        share_at_zero=1 - int(np.count_nonzero(values)) / values.size,
        blur_px=float(np.sqrt(max(at.registration.blur_px**2 + blur_growth_px2, 0.0))),
        exposure=decoded.mosaic.origin.exposure,
        origin=decoded.mosaic.origin,
    )
    return MeasuredFrame(figures, registered, decoded.saturation, values, highest, at.cells.inside, kept, noise)


def _to_subtract(
    decoded: DecodedFrame, at: RegisteredFrame, references: npt.NDArray[np.float32], dark: DarkLight | None
) -> npt.NDArray[np.float32] | None:
    """Return what is subtracted from each patch, (P, 3) float32 counts: dark light, and what the lens added.

    `references` are the references' samples. None where nothing is subtracted.
    """
    if at.lens is None:
        return None if dark is None else dark.patches
    cells = gather_means(decoded.mosaic, decoded.black, at.cells)
    means = np.concatenate([cells, references.mean(axis=1, dtype=np.float64)])
    if dark is not None:
        means -= dark.patches
    added = at.lens.added(FrameLevels(means, beyond_print(decoded, at.lens.beyond))).astype(np.float32)
    return added if dark is None else added + dark.patches
