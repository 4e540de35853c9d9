"""Compute a look-up table (LUT) and write it in the format of `build-lut`.

The same camera, illuminants, settings and seed give the same bytes with any number of threads. Computed frames are
evaluated like photographs in `calibration.pipeline.measuring`: the black level is subtracted, flat field and white are
measured on the white references, and samples are divided by the flat field. The primaries of a projector have different
flat fields, so the divisor depends on the colour of the patch. Therefore the ground truth has the same kinds of errors
as in a LUT from photographs.
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
from experiment.lights import Illuminant
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
    """Measurements of the frame under one illuminant; C patches with S samples each, G grey levels."""

    light: int  # Index of the illuminant
    values: npt.NDArray[np.uint16]  # (C, S, 3), samples of the LUT
    share_at_zero: float  # Share of samples that are 0
    highest: npt.NDArray[np.uint16]  # (C,), highest raw count of each patch
    black: _Array  # (2, 2) float64, subtracted black level in counts
    paper: Paper  # Measurements on bare paper: flat field, ground truth and its standard error
    greys: _Array  # (G, 3) float64, counts of each grey level, divided by the flat field
    grey_errors: _Array  # (G, 3) float64, their standard errors


@dataclass(frozen=True, eq=False)
class PatchMeasurement:
    """Measurement of the frames of all illuminants; made by `PatchMeasurement.of`."""

    points: ChartPoints  # Patches and references of the chart
    sensor: PatchSensor  # Photosites of patches, white references and grey references, in this order
    lamp: ChartLamp
    iso: int
    reader: PaperReader  # Measures flat field and white; its base is the flat field of the white frame
    primaries: Primaries | None = None  # Correction of the flat field for coloured patches; None for spectra

    @staticmethod
    def of(
        points: ChartPoints, page_mm: tuple[float, float], tagged: bool, sensor: PatchSensor, lamp: ChartLamp, iso: int
    ) -> PatchMeasurement:
        """Measure a white frame and the frames of the primaries."""
        reader = PaperReader(points.whites_mm, points.cells_mm, page_mm)
        first = PatchMeasurement(points, sensor, lamp, iso, reader)
        # Charts with tags have white references among the patches; other charts, only around the patches.
        order = MAX_ORDER if tagged else MAX_ORDER_AROUND
        base = first._white_frame_paper().field
        uncorrected = replace(first, reader=PaperReader(points.whites_mm, points.cells_mm, page_mm, base, order))
        primaries = lamp.primary_indices()
        if primaries is None:
            return uncorrected
        frames = [uncorrected.measure(light) for light in primaries]
        papers, cells = [frame.paper for frame in frames], [patch_means(frame.values) for frame in frames]
        return replace(uncorrected, primaries=Primaries.of(primaries, papers, cells, points.cells_mm))

    def measure(self, light: int) -> ComputedFrame:
        """Compute and measure the frame under an illuminant; may be called by several threads."""
        mosaic, black = self.sensor.expose(*self.lamp.illuminate(light), self.iso, light + 1)
        cells, references = self._sites()
        samples, highest = gather(mosaic, black, references)
        means = usable_means(samples, highest, references, mosaic.saturation())
        whites, greys = np.split(means, [len(self.points.whites_mm)])
        _require_unclipped(whites, f"illuminant {light}")
        paper, cell_field = self.reader.read(whites, f"illuminant {light}")
        if self.primaries is not None:
            cell_field = cell_field * self.primaries.field_ratio(paper.white)
        grey_values, grey_errors = self.points.levels.read(greys, paper.field.at(self.points.greys_mm))
        values, highest = gather_values(mosaic, black, cells, cell_field)
        share_at_zero = 1 - int(np.count_nonzero(values)) / values.size
        return ComputedFrame(light, values, share_at_zero, highest, black, paper, grey_values, grey_errors)

    def _white_frame_paper(self) -> Paper:
        mosaic, black = self.sensor.expose(*self.lamp.illuminate_evenly(), self.iso, 0)
        _, references = self._sites()
        means = usable_means(*gather(mosaic, black, references), references, mosaic.saturation())
        whites = means[: len(self.points.whites_mm)]
        _require_unclipped(whites, "the white frame")
        return self.reader.read(whites, "the white frame")[0]

    def _sites(self) -> tuple[Sites, Sites]:
        sites, count = self.sensor.sites, len(self.points.cells_mm)
        return (
            Sites(sites.rows[:count], sites.columns[:count], sites.inside[:count], sites.window),
            Sites(sites.rows[count:], sites.columns[count:], sites.inside[count:], sites.window),
        )


def _require_unclipped(whites: _Array, frame_name: str) -> None:
    # Clipped references are NaN.
    usable = int(np.isfinite(whites).all(axis=1).sum())
    if usable < MIN_REFERENCES:
        raise QualityError(
            f"{frame_name}: {usable} of {len(whites)} references are unclipped, expected {MIN_REFERENCES} or more; "
            "reduce room.white_level_share in the settings; without --lights, exposure.shutter_s may be reduced instead"
        )


ReportLights = Callable[[int, int], None]  # Called with the number of completed illuminants and their total

# Disk space for text files, bytes: lut.json has 2.2 kB per illuminant, references.csv a third of that.
SPARE_BYTES: Final = 16 << 20


@dataclass(frozen=True, eq=False)
class TableTask:
    """A LUT to compute."""

    chart: Chart
    body: Body
    room: Room
    exposure: ExposureSettings
    illuminations: tuple[Illuminant, ...]
    powers: _Array | None  # (L, 81) float64, spectra in relative power per nm; None for the simulated projector
    window: int  # Side of the window of a patch, in half-size pixels
    record: dict[str, Any]  # Written to lut.json under `computed`
    origin: OriginRecord | None = None  # Citation; None if the settings have none

    @property
    def sample_bytes(self) -> int:
        """Size of `samples.npy` without its header, in bytes."""
        return len(self.illuminations) * self.chart.colour_count * self.window**2 * 6


@dataclass(frozen=True, eq=False)
class ComputedTable:
    """Folder of a computed LUT, and the numbers of illuminants, patches and unfit (clipped) patches."""

    folder: Path
    lights: int
    cells: int
    unfit: int


def compute_table(task: TableTask, out: Path, threads: int, progress: ReportLights | None = None) -> ComputedTable:
    """Compute a LUT with `threads` threads, and write it to the folder `out`."""
    require_free(out, "the LUT")
    _require_disk_space(out, task.sample_bytes + SPARE_BYTES)
    measurement = _measurement(task)
    lights, cells = len(task.illuminations), task.chart.colour_count
    with atomic_folder(out, "the LUT") as folder:
        writer = LutWriter(folder, lights, cells, task.window**2)

        def compute(light: int) -> ComputedFrame:
            # The samples are on disk and need not stay in memory.
            frame = measurement.measure(light)
            writer.put(light, frame.values)
            return replace(frame, values=frame.values[:0].copy())

        frames: list[ComputedFrame] = []
        for frame in ordered_map(compute, range(lights), threads):
            frames.append(frame)
            if progress is not None:
                progress(len(frames), lights)
        unfit = _clipped_cells(frames, task.body.saturation)
        white = np.array([frame.paper.white for frame in frames])
        provenance = _provenance(task, measurement, frames, white, unfit)
        levels = measurement.points.levels.names
        files: dict[str, str] = {}
        if levels:
            errors = np.array([frame.paper.error for frame in frames])
            greys, grey_errors = (np.array([getattr(f, name) for f in frames]) for name in ("greys", "grey_errors"))
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
    positions_mm = np.concatenate([points.cells_mm, points.references_mm])
    sensor = PatchSensor.of(task.body, len(codes), task.window, task.room, task.exposure.shutter_s)
    blank = Print(chart.page_mm, np.zeros((0, 4)), np.zeros((0, 3), dtype=np.uint8))
    world = World(blank, task.body, task.room)
    lamp: ChartLamp
    if task.powers is None:
        light = sensor.light(world.signals_of_primaries(codes, positions_mm))
        lamp = ProjectorLamp(world, task.exposure, task.illuminations, light)
    else:
        reflectance = printed_reflectance(codes, task.room.profile, task.room.paper)
        lamp = SpectralLamp(world, task.powers, sensor, reflectance, world.field(positions_mm)[:, 1])
    return PatchMeasurement.of(points, chart.page_mm, bool(chart.tags), sensor, lamp, task.exposure.iso)


def _clipped_cells(frames: Sequence[ComputedFrame], saturation: int) -> list[Unfit]:
    allowed = CLIPPING_SHARE * saturation
    highest = np.array([frame.highest for frame in frames])
    unfit: list[Unfit] = []
    for colour in np.flatnonzero(highest.max(axis=0) >= allowed).tolist():
        light = int(highest[:, colour].argmax())
        cause = f"clipped: {int(highest[light, colour])} counts under illuminant {light}, limit {allowed:.0f} counts"
        unfit.append(Unfit(colour=colour, cause=cause))
    return unfit


def _provenance(
    task: TableTask, measurement: PatchMeasurement, frames: Sequence[ComputedFrame], white: _Array, unfit: list[Unfit]
) -> Provenance:
    black = np.array([frame.black for frame in frames])
    records = corrections(
        task.chart.page_mm,
        black,
        task.body.saturation,
        [frame.paper.field for frame in frames],
        saturation_from="settings",
        at_zero=np.array([frame.share_at_zero for frame in frames]),
    )
    if measurement.primaries is not None:
        records.append(measurement.primaries.correction(white))
    return Provenance(
        camera=task.body.camera,
        bits=task.chart.bits,
        white_level=round(task.body.saturation - float(black.mean())),
        corrections=records,
        session_sha256=frames_sha256(()),
        chart_sha256=task.chart.sha256,
        software=software(),
        unfit=unfit,
        computed=task.record,
        origin=task.origin,
    )


def _require_disk_space(out: Path, needed: int) -> None:
    folder = out.absolute()
    while not folder.exists():
        folder = folder.parent
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < needed:
        raise StorageError(
            f"{out}: the LUT needs {needed / 1e9:.2f} GB, the disk has {free_bytes / 1e9:.2f} GB free; free space or "
            "choose another disk"
        )
