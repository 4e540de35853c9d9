"""A whole table, lights by cells by samples, computed light by light and written as `build-lut` writes one.

The same camera, lights, settings and seed give the same bytes, on any number of threads. A light's frame is treated as
`calibration.pipeline.measuring` treats a photographed one that lies exactly where it was registered: black subtracted,
field and white read from the white references, samples divided by the field, and by how much the field of a cell
differs from that of paper. So the ground truth has the error that a photographed one has.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from calibration.citation import OriginRecord
from calibration.pipeline.measuring import ChartPoints, usable_means
from calibration.radiometry.drift import corrections
from calibration.radiometry.primaries import Primaries
from calibration.sampling import Sites, gather, gather_values, patch_means
from calibration.table.lut import REFERENCES, Provenance, Unfit, frames_sha256
from calibration.table.writing import LutWriter, references_csv
from drivers.camera import ExposureSettings
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.chart.model import Chart
from experiment.lights import Illumination
from experiment.measures.paper import MAX_ORDER, MAX_ORDER_AROUND, MIN_REFERENCES, Paper, PaperReader
from foundation.compiled import ordered_map
from foundation.errors import QualityError, StorageError
from foundation.folders import atomic_folder, require_free
from foundation.version import software
from sim.spectral import printed_reflectance
from sim.world.rendering import Print
from sim.world.sensors import Body
from sim.world.world import Room, World
from synthesis.lamps import ChartLamp, PatchSensor, ProjectorLamp, SpectralLamp

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ComputedFrame:
    """What the frame of one light shows; C cells of S samples, G levels of grey.

    - `light`: number of the light.
    - `values`: (C, S, 3) uint16, the table's samples.
    - `share_at_zero`: of the samples, how many are 0.
    - `highest`: (C,) uint16, the highest raw count of each cell.
    - `black`: (2, 2) float64 counts, the black level that was subtracted.
    - `paper`: field, ground truth and its standard error.
    - `greys`, `grey_errors`: (G, 3) float64 counts of each level of grey, field divided out, and their standard errors.
    """

    light: int
    values: npt.NDArray[np.uint16]
    share_at_zero: float
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
        seen = usable_means(samples, highest, references, mosaic.saturation())
        whites, greys = np.split(seen, [len(self.points.whites_mm)])
        _require_unclipped(whites, f"light {light}")
        paper, shape = self.reader.read(whites, f"light {light}")
        if self.primaries is not None:
            shape = shape * self.primaries.field_ratio(paper.white)
        grey_values, grey_errors = self.points.levels.read(greys, paper.field.at(self.points.greys_mm))
        values, highest = gather_values(mosaic, black, cells, shape)
        at_zero = 1 - int(np.count_nonzero(values)) / values.size
        return ComputedFrame(light, values, at_zero, highest, black, paper, grey_values, grey_errors)

    def _paper_of_even_frame(self) -> Paper:
        mosaic, black = self.sensor.expose(*self.lamp.even(), self.iso, 0)
        _, references = self._sites()
        seen = usable_means(*gather(mosaic, black, references), references, mosaic.saturation())
        whites = seen[: len(self.points.whites_mm)]
        _require_unclipped(whites, "the frame of white")
        return self.reader.read(whites, "the frame of white")[0]

    def _sites(self) -> tuple[Sites, Sites]:
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


ReportLights = Callable[[int, int], None]  # Called with the number of lights computed, and the number of all

# Room for a table's text files: `lut.json` holds 2.2 kB a light (707 lights take 1.6 MB), `references.csv` a third.
SPARE_BYTES: Final = 16 << 20


@dataclass(frozen=True, eq=False)
class TableTask:
    """A table that is to be computed.

    - `chart`: the chart that is thought to hang there.
    - `body`, `room`: the camera and the room.
    - `exposure`: of every frame.
    - `powers`: (L, 81) float64, their spectra, relative power per nm (`synthesis.lamps.SpectralLamp`); None for those
      that the simulated projector shows.
    - `window`: half-size pixels along a window's side.
    - `record`: what the provenance says under `computed`.
    - `origin`: title, authors, licence, note and address of the table; None if the settings have none.
    """

    chart: Chart
    body: Body
    room: Room
    exposure: ExposureSettings
    illuminations: tuple[Illumination, ...]
    powers: _Array | None
    window: int
    record: dict[str, Any]
    origin: OriginRecord | None = None

    @property
    def sample_bytes(self) -> int:
        """Bytes of `samples.npy`, but for its header."""
        return len(self.illuminations) * self.chart.colour_count * self.window**2 * 6


@dataclass(frozen=True, eq=False)
class ComputedTable:
    """What came of it: where it is, how many lights and cells it has, and how many cells are listed as unfit."""

    folder: Path
    lights: int
    cells: int
    unfit: int


def compute_table(task: TableTask, out: Path, threads: int, progress: ReportLights | None = None) -> ComputedTable:
    """Compute a table and write it.

    `threads`: how many lights are computed at a time; without effect on the bytes.
    """
    require_free(out, "the table")
    _require_room(out, task.sample_bytes + SPARE_BYTES)
    measurement = _measurement(task)
    lights, cells = len(task.illuminations), task.chart.colour_count
    with atomic_folder(out, "the table") as folder:
        writer = LutWriter(folder, lights, cells, task.window**2)

        def compute(light: int) -> ComputedFrame:
            """Return all of a light's frame but its samples, which are written."""
            frame = measurement.measure(light)
            writer.put(light, frame.values)
            return replace(frame, values=frame.values[:0].copy())

        kept: list[ComputedFrame] = []
        for one in ordered_map(compute, range(lights), threads):
            kept.append(one)
            if progress is not None:
                progress(len(kept), lights)
        unfit = _clipped_cells(kept, task.body.saturation)
        white = np.array([one.paper.white for one in kept])
        provenance = _provenance(task, measurement, kept, white, unfit)
        levels = measurement.points.levels.names
        files: dict[str, str] = {}
        if levels:
            errors = np.array([one.paper.error for one in kept])
            greys, grey_errors = (np.array([getattr(one, name) for one in kept]) for name in ("greys", "grey_errors"))
            files[REFERENCES] = references_csv(levels, white, errors, greys, grey_errors)
        writer.finish(task.illuminations, white, provenance, files=files)
    return ComputedTable(out, lights, cells, len(unfit))


def _measurement(task: TableTask) -> PatchMeasurement:
    chart = task.chart
    points = ChartPoints.of(chart)
    greys = [reference for reference in chart.references if not reference.is_white]
    codes = np.concatenate(
        [
            chart.rgb[chart.cell_of_colour],
            np.array([reference.rgb for reference in (*chart.white_references, *greys)], dtype=np.uint8),
        ]
    )
    places = np.concatenate([points.cells_mm, points.references_mm])
    sensor = PatchSensor.of(task.body, len(codes), task.window, task.room, task.exposure.shutter_s)
    blank = Print(chart.page_mm, np.zeros((0, 4)), np.zeros((0, 3), dtype=np.uint8))
    world = World(blank, task.body, task.room)
    lamp: ChartLamp
    if task.powers is None:
        light = sensor.light(world.of_primaries(codes, places))
        lamp = ProjectorLamp(world, task.exposure, task.illuminations, light)
    else:
        reflectance = printed_reflectance(codes, task.room.profile, task.room.paper)
        lamp = SpectralLamp(world, task.powers, sensor, reflectance, world.field(places)[:, 1])
    return PatchMeasurement.of(points, chart.page_mm, bool(chart.tags), sensor, lamp, task.exposure.iso)


def _clipped_cells(kept: Sequence[ComputedFrame], saturation: int) -> list[Unfit]:
    allowed = CLIPPING_SHARE * saturation
    highest = np.array([one.highest for one in kept])
    found: list[Unfit] = []
    for colour in np.flatnonzero(highest.max(axis=0) >= allowed).tolist():
        light = int(highest[:, colour].argmax())
        cause = f"clipped: {int(highest[light, colour])} counts under light {light}, below {allowed:.0f} allowed"
        found.append(Unfit(colour=colour, cause=cause))
    return found


def _provenance(
    task: TableTask, measurement: PatchMeasurement, kept: Sequence[ComputedFrame], white: _Array, unfit: list[Unfit]
) -> Provenance:
    black = np.array([one.black for one in kept])
    done = corrections(
        task.chart.page_mm,
        black,
        task.body.saturation,
        [one.paper.field for one in kept],
        saturation_from="settings",
        at_zero=np.array([one.share_at_zero for one in kept]),
    )
    if measurement.primaries is not None:
        done.append(measurement.primaries.correction(white))
    return Provenance(
        camera=task.body.camera,
        bits=task.chart.bits,
        white_level=round(task.body.saturation - float(black.mean())),
        corrections=done,
        session_sha256=frames_sha256(()),
        chart_sha256=task.chart.sha256,
        software=software(),
        unfit=unfit,
        computed=task.record,
        origin=task.origin,
    )


def _require_room(out: Path, needed: int) -> None:
    there = out.absolute()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if free < needed:
        raise StorageError(
            f"{out}: the table takes {needed / 1e9:.2f} GB, the disk has {free / 1e9:.2f} GB left; free space, or name "
            "a place on another disk"
        )
