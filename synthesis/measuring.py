"""What frames of patches show: field, ground truth, greys and samples, by calibration's own functions.

A light's frame is treated as `calibration.pipeline.measuring` treats a photographed one that lies exactly where it was
registered: black subtracted, field and white read from the white references, samples divided by the field, and by how
much the field of a cell differs from that of paper. So the ground truth has the error that a photographed one has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calibration.pipeline.baseline import ChartPoints, usable_means
from calibration.radiometry.primaries import Primaries
from calibration.sampling import Sites, gather, gather_values, patch_means
from experiment.measures.paper import MAX_ORDER, MAX_ORDER_AROUND, MIN_REFERENCES, Paper, PaperReader
from experiment.measures.sensor_range import saturation
from foundation.errors import QualityError
from synthesis.lamps import ChartLamp
from synthesis.patch_frames import PatchSensor

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ComputedFrame:
    """What the frame of one light shows; C cells of S samples, G levels of grey.

    - `light`: number of the light.
    - `values`: (C, S, 3) uint16, the table's samples.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `black`: (2, 2) float64 counts, the black level that was subtracted.
    - `paper`: field, ground truth and its standard error.
    - `greys`, `grey_errors`: (G, 3) float64 counts of each level of grey, field divided out, and their standard errors.
    """

    light: int
    values: npt.NDArray[np.uint16]
    highest: npt.NDArray[np.uint16]
    black: _Array
    paper: Paper
    greys: _Array
    grey_errors: _Array


@dataclass(frozen=True, eq=False)
class PatchMeasurement:
    """What holds for the frames of all lights; made by `PatchMeasurement.of`.

    - `points`: the chart's cells and references.
    - `sensor`: the photosites under them: cells first, then white, then grey references.
    - `lamp`: what lights them.
    - `iso`: ISO speed.
    - `reader`: reads field and white, with the field of the even frame as base.
    - `primaries`: how the field of coloured cells differs from that of paper; None where the light has no primaries.
    """

    points: ChartPoints
    sensor: PatchSensor
    lamp: ChartLamp
    iso: int
    reader: PaperReader
    primaries: Primaries | None = None

    @staticmethod
    def of(
        points: ChartPoints, page_mm: tuple[float, float], among: bool, sensor: PatchSensor, lamp: ChartLamp, iso: int
    ) -> PatchMeasurement:
        """Return what holds for all lights, from an even frame and those of the primaries."""
        reader = PaperReader(points.whites_mm, points.cells_mm, page_mm)
        first = PatchMeasurement(points, sensor, lamp, iso, reader)
        order = MAX_ORDER if among else MAX_ORDER_AROUND
        base = first._paper_of_even_frame().field
        plain = replace(first, reader=PaperReader(points.whites_mm, points.cells_mm, page_mm, base, order))
        pure = lamp.pure()
        if pure is None:
            return plain
        frames = [plain.measure(light) for light in pure]
        papers, cells = [frame.paper for frame in frames], [patch_means(frame.values) for frame in frames]
        return replace(plain, primaries=Primaries.of(pure, papers, cells, points.cells_mm))

    def measure(self, light: int) -> ComputedFrame:
        """Return what the frame of a light shows; any thread may ask for any light."""
        mosaic, black = self.sensor.expose(*self.lamp.lit(light), self.iso, light + 1)
        cells, references = self._sites()
        samples, highest = gather(mosaic, black, references)
        seen = usable_means(samples, highest, references, saturation(mosaic))
        whites, greys = np.split(seen, [len(self.points.whites_mm)])
        _require_unclipped(whites, f"light {light}")
        paper, shape = self.reader.read(whites, f"light {light}")
        if self.primaries is not None:
            shape = shape * self.primaries.field_ratio(paper.white)
        grey_values, grey_errors = self.points.levels.read(greys, paper.field.at(self.points.greys_mm))
        values, highest = gather_values(mosaic, black, cells, shape)
        return ComputedFrame(light, values, highest, black, paper, grey_values, grey_errors)

    def _paper_of_even_frame(self) -> Paper:
        mosaic, black = self.sensor.expose(*self.lamp.even(), self.iso, 0)
        _, references = self._sites()
        seen = usable_means(*gather(mosaic, black, references), references, saturation(mosaic))
        whites = seen[: len(self.points.whites_mm)]
        _require_unclipped(whites, "the frame of white")
        return self.reader.read(whites, "the frame of white")[0]

    def _sites(self) -> tuple[Sites, Sites]:
        """Return where the cells lie in a frame of patches, and where the references."""
        sites, count = self.sensor.sites, len(self.points.cells_mm)
        return (
            Sites(sites.rows[:count], sites.columns[:count], sites.inside[:count], sites.window),
            Sites(sites.rows[count:], sites.columns[count:], sites.inside[count:], sites.window),
        )


def _require_unclipped(whites: _Array, what: str) -> None:
    """Refuse white references (W, 3), NaN where clipped, of which too few are left."""
    left = int(np.isfinite(whites).all(axis=1).sum())
    if left < MIN_REFERENCES:
        raise QualityError(
            f"{what}: bare paper is clipped in {len(whites) - left} of {len(whites)} white references; expose less: a "
            "smaller room.white_level_share in the settings, or under the projector exposure.shutter_s"
        )
