"""Where the chart lies, from the frame in which it was registered until it moves too far from there.

Rules that hold inside:

- Cells are in the order of colour indices, as in the table, and not in the chart's own order.
- References follow the cells, the white ones before the grey ones.

C cells, W white references, N grey references; places on the print in millimetres, in frames in half-size pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.pipeline.frames import DecodedFrame
from calibration.pipeline.options import BuildOptions
from calibration.radiometry.greys import GreyLevels
from calibration.registration.register import register
from calibration.registration.registration import Registration
from calibration.sampling.samples import Sites, sites_at
from calibration.spread.correction import FrameCorrection
from experiment.chart.model import Chart
from experiment.framing.movement import gauges_of
from experiment.framing.planes import CHANNELS, Channel, Plane

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ChartPoints:
    """The points of a chart that are sampled.

    - `cells_mm`: (C, 2) float64 mm, centres of the cells in the order of colour indices.
    - `whites_mm`, `greys_mm`: (W, 2) and (N, 2) float64 mm, centres of the white and of the grey references.
    - `levels`: the level of each grey reference.
    """

    cells_mm: _Array
    whites_mm: _Array
    greys_mm: _Array
    levels: GreyLevels

    @staticmethod
    def of(chart: Chart) -> ChartPoints:
        """Return the points of a chart."""
        whites = [reference for reference in chart.references if reference.is_white]
        greys = [reference for reference in chart.references if not reference.is_white]
        whites_mm, greys_mm = (
            np.array([reference.centre_mm for reference in references]).reshape(-1, 2) for references in (whites, greys)
        )
        return ChartPoints(chart.centres_mm[chart.cell_of_colour], whites_mm, greys_mm, GreyLevels.of(greys))

    @property
    def references_mm(self) -> _Array:
        """(W + N, 2) float64 mm, centres of the references."""
        return np.concatenate([self.whites_mm, self.greys_mm])


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame in which the chart was registered; it holds for those after it until the chart moves too far.

    - `registration`: the chart's place in it.
    - `cells`: where the C cells are sampled.
    - `references`: where the W + N references are sampled.
    - `gauges`: the frame around its tags, or the outline of its field, to measure movements against.
    - `lens`: corrects frames sampled at these places for what the lens spreads; None where nothing is corrected.
    """

    file: str
    registration: Registration
    cells: Sites
    references: Sites
    gauges: dict[Channel, Plane]
    lens: FrameCorrection | None = None


def register_frame(
    decoded: DecodedFrame, chart: Chart, points: ChartPoints, options: BuildOptions, near: Registration | None = None
) -> RegisteredFrame:
    """Return a frame with the chart registered in it."""
    registration = register(decoded.mosaic, chart, decoded.record.file, options.corners, near)
    cells, references = sites_of(registration, points, decoded.mosaic.block_planes().shape[2:], options.window)
    gauges: dict[Channel, Plane] = {
        channel: gauges_of(decoded.mosaic, channel, decoded.black, registration.framing) for channel in CHANNELS
    }
    return RegisteredFrame(decoded.record.file, registration, cells, references, gauges)


def sites_of(
    registration: Registration, points: ChartPoints, shape: tuple[int, ...], window: int
) -> tuple[Sites, Sites]:
    """Return the sites of the cells and of the references.

    `shape` is rows and columns of the half-size frame, `window` the pixels along a window's side.
    """
    height, width = shape
    cells, references = (
        sites_at(registration.to_pixels(places), (height, width), window)
        for places in (points.cells_mm, points.references_mm)
    )
    return cells, references
