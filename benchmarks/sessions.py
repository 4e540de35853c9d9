"""Short simulated sessions with frames that differ from the plan, and the comparison of their LUTs with the truth.

A `FrameChange` describes how one frame differs from the plan: another illuminant or camera, another exposure or file
header, a disturbance in the room, changed counts. `frame_file` makes the file of a step and `record_session` a whole
session. `compare` compares a LUT with the truth: camera, room and chart of the session without any change.

Noise does not count as an error of a LUT. The counts of each frame without noise are known here, so the noise of each
patch mean can be subtracted. The remaining error is systematic and includes hot photosites.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.measurements import FrameMeasurements
from calibration.registration.register import Registration
from calibration.sampling import sites_at
from calibration.table.lut import CELLS, Lut
from calibration.verdict import BuildResult
from drivers.camera import CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from drivers.raw.rawfile import CHANNELS, read_raw
from experiment.chart.model import Chart
from experiment.chart.printing import drawing
from experiment.framing.pictures import STILL_PX
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.journal import ReceivedFile
from experiment.session.records import Judgement, SessionStep, plan_steps
from foundation.colorimetry import angles_deg
from sim.camera.film import write_dng
from sim.world.rendering import Print
from sim.world.sensors import Body
from sim.world.world import PAPER, UNDISTURBED, Room, Situation, World

SETTINGS = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
TAKEN_AT = datetime(2024, 3, 1, 9, 0, tzinfo=UTC)
SECONDS_A_FRAME = 4
WELL_LIT_DN = 300.0

# Illuminants of a short session by name: primaries, white, a warm and a cool white, two mixtures.
EIGHT_LIGHTS: Mapping[str, Colour] = {
    "red": Colour(255, 0, 0),
    "green": Colour(0, 255, 0),
    "blue": Colour(0, 0, 255),
    "white": Colour(255, 255, 255),
    "warm": Colour(255, 164, 73),
    "cool": Colour(200, 218, 255),
    "violet": Colour(180, 60, 255),
    "dim": Colour(110, 70, 20),
}

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]
_Counts = npt.NDArray[np.uint16]


def short_plan(lights: Mapping[str, Colour] = EIGHT_LIGHTS) -> tuple[Illuminant, ...]:
    """Return named illuminants as the plan of a session."""
    return tuple(
        Illuminant(index, "uniform", None, colour, name) for index, (name, colour) in enumerate(lights.items())
    )


@lru_cache(maxsize=1)
def world_of(chart: Chart, body: Body, room: Room) -> World:
    """Return a chart in a room with a camera; the last one is cached, because its light takes as long as ten frames."""
    return World(_printed(chart), body, room)


@lru_cache(maxsize=4)
def _printed(chart: Chart) -> Print:
    """Return the print of a chart; it is cached, because placing the margin marks takes seconds."""
    print_image = drawing(chart)
    return Print(print_image.page_mm, print_image.rectangles_mm, print_image.rgb)


@dataclass(frozen=True, eq=False)
class FrameChange:
    """Differences of one frame from the plan."""

    colour: Colour | None = None  # colour of the projector, if another
    settings: ExposureSettings = SETTINGS  # exposure, also recorded in the file
    tagged: ExposureSettings | None = None  # exposure recorded in the file, if another
    world: World | None = None  # another camera, room or chart
    situation: Situation = UNDISTURBED  # disturbance in the room
    # counts added to photosites (row, column) of the sensor
    counts_added: Mapping[tuple[int, int], int] = field(default_factory=dict[tuple[int, int], int])
    serial: str = "000000000000"  # serial number in the file
    reason: str | None = None  # reason of a rejection; None if accepted
    number: int | None = None  # step that determines noise and time, if another


AS_PLANNED = FrameChange()

Changes = Callable[[SessionStep], FrameChange]


def as_planned(step: SessionStep) -> FrameChange:
    """Return no differences."""
    return AS_PLANNED


def light_named(lights: Sequence[Illuminant], step: SessionStep) -> str | None:
    """Return the name of the illuminant of a step; None for references."""
    return None if step.illumination is None else lights[step.illumination].name


def counts_of(world: World, step: SessionStep, change: FrameChange = AS_PLANNED) -> _Counts:
    """Return the counts of the whole sensor; the noise depends only on the room and the step number."""
    actual_world, number = change.world or world, _number_of(step, change)
    counts = actual_world.expose(
        change.colour or step.colour, change.settings, key=(number,), situation=change.situation
    )
    for site, added in change.counts_added.items():
        counts[site] = min(int(counts[site]) + added, actual_world.body.saturation)
    return counts


def _number_of(step: SessionStep, change: FrameChange) -> int:
    return step.number if change.number is None else change.number


def expected_counts(world: World, step: SessionStep, change: FrameChange = AS_PLANNED) -> npt.NDArray[np.float32]:
    """Return the counts above black of the visible photosites without noise, (rows, columns) float32."""
    actual_world = change.world or world
    expected = actual_world.signal(change.colour or step.colour, change.settings, situation=change.situation)
    visible, body = actual_world.body.visible, actual_world.body
    rows, columns = actual_world.hot.rows - visible.top, actual_world.hot.columns - visible.left
    inside = (rows >= 0) & (rows < visible.height) & (columns >= 0) & (columns < visible.width)
    excess = actual_world.hot.excess_dn(change.settings.iso, change.settings.shutter_s)
    expected[rows[inside], columns[inside]] += excess[inside].astype(np.float32)
    for (row, column), added in change.counts_added.items():
        expected[row - visible.top, column - visible.left] += added
    return np.minimum(expected, body.saturation - body.black, out=expected)


def frame_file(world: World, step: SessionStep, change: FrameChange = AS_PLANNED) -> bytes:
    """Return the raw file of a step."""
    stream, body = BytesIO(), (change.world or world).body
    write_dng(
        stream,
        counts_of(world, step, change),
        body,
        settings=change.tagged or change.settings,
        taken_at=TAKEN_AT + timedelta(seconds=SECONDS_A_FRAME * _number_of(step, change)),
        serial=change.serial,
    )
    return stream.getvalue()


def record_session(
    folder: Path,
    chart: Chart,
    lights: Sequence[Illuminant],
    frame: Callable[[SessionStep], bytes],
    *,
    every: int = 25,
    reason: Callable[[SessionStep], str | None] | None = None,
    settings: str = "rig = 'simulated'\n",
    steps: Sequence[SessionStep] | None = None,
) -> Session:
    """Record a session with a frame for every step of its plan, and open it.

    `reason` returns why a frame is refused, or None. `steps` replaces the usual plan.
    """
    with Session.create(folder, settings, chart, lights) as session:
        for step in plan_steps(lights, every) if steps is None else steps:
            data = frame(step)
            taken_at = TAKEN_AT + timedelta(seconds=SECONDS_A_FRAME * step.number)
            path = session.frames_folder / f"{step.stem}.dng"
            attempt = session.journal.begin(step, f"frames/{path.name}", taken_at)
            path.write_bytes(data)
            captured = CapturedFrame(path.name, len(data), taken_at)
            received = ReceivedFile(path, len(data), hashlib.sha256(data).hexdigest(), captured)
            judgement = Judgement.of_reason("exposure", None if reason is None else reason(step))
            session.journal.commit(attempt, received, judgement, exposure_s=SETTINGS.shutter_s, ended_at=taken_at)
        session.write_frames_csv()
    return Session.open(folder)


def short_session(
    folder: Path,
    chart: Chart,
    world: World,
    changes: Changes = as_planned,
    lights: Sequence[Illuminant] | None = None,
    every: int = 25,
    settings: str = "rig = 'simulated'\n",
) -> Session:
    """Record a session of a few illuminants with `changes`, and open it.

    A session without one of its files is made by a plan without that illuminant.
    """
    return record_session(
        folder,
        chart,
        short_plan() if lights is None else lights,
        lambda step: frame_file(world, step, changes(step)),
        every=every,
        reason=lambda step: changes(step).reason,
        settings=settings,
    )


@dataclass(frozen=True, eq=False)
class TableTruth:
    """Errors of a LUT, compared with the room that it should show; L illuminants, C patches."""

    light_deg: _Array  # (L,) angle between ground truth and mean light of bare paper over the patches
    light_uncertainty: _Array  # (L,) degrees, reported by the LUT
    cell_uncertainty: _Array  # (C, 3) reported by the LUT
    brightness: _Array  # (L,) brightness / true brightness; 1 for the median illuminant
    level: _Array  # (L, C, 3) true counts in the LUT
    error: _Array  # (L, C, 3) mean / true mean − 1 without noise and without errors of the illuminant
    fit: _Mask  # (C,) patches that the LUT lists as fit
    offset_px: _Array  # (3, C, 2) registered − true position by channel, half-size px

    @property
    def lit(self) -> _Mask:
        """Means of fit patches from 300 counts on, (L, C, 3) bool."""
        return (self.level >= WELL_LIT_DN) & self.fit[:, None]

    @property
    def rms(self) -> float:
        """RMS of `error` for lit patches."""
        return float(np.sqrt((self.error[self.lit] ** 2).mean())) if self.lit.any() else 0.0

    @property
    def worst(self) -> float:
        """Largest absolute `error` of lit patches."""
        return float(np.abs(self.error[self.lit]).max(initial=0))

    @property
    def cell_error(self) -> _Array:
        """Absolute errors of patch means including the brightness error, (L, C, 3)."""
        return np.abs((1 + self.error) * self.brightness[:, None, None] - 1)

    def cells_beyond(self, share: float) -> int:
        """Return the number of fit patches with a lit error above `share`."""
        return int((self.lit & (np.abs(self.error) > share)).any(axis=(0, 2)).sum())

    def offset_rms_px(self) -> tuple[float, float, float]:
        """Return the RMS position error in red, green and blue, half-size px."""
        red, green, blue = np.sqrt((self.offset_px**2).sum(axis=-1).mean(axis=-1)).tolist()
        return red, green, blue

    def worst_offset_px(self) -> float:
        """Return the largest position error of a fit patch in any channel, half-size px."""
        return float(np.linalg.norm(self.offset_px[:, self.fit], axis=-1).max(initial=0))


def compare(
    result: BuildResult,
    lut: Lut,
    world: World,
    chart: Chart,
    session: Session,
    changes: Changes = as_planned,
    every: int = 25,
) -> TableTruth:
    """Compare a LUT with the room that it should show."""
    lights = lut.illuminations
    cells_mm = chart.centres_mm[chart.cell_of_colour]
    codes = chart.rgb[chart.cell_of_colour]
    paper = [PAPER] * len(cells_mm)
    white = np.array([world.camera_rgb_at(paper, cells_mm, light.colour, SETTINGS).mean(axis=0) for light in lights])
    if result.figures.lights.subtracted is not None:
        white -= world.camera_rgb_at(paper, cells_mm, BLACK, SETTINGS).mean(axis=0)
    records = {frame.record.illumination: frame for frame in result.figures.frames if frame.record.kind == "light"}
    steps = {step.illumination: step for step in plan_steps(lights, every) if step.kind == "light"}
    level, error = (np.zeros((len(lights), len(codes), 3)) for _ in range(2))
    for number, light in enumerate(lights):
        relative = world.reflected(codes, light.colour, SETTINGS) / world.white(light.colour, SETTINGS)
        level[number] = relative * lut.white[number]
        means = lut.samples[number].astype(np.float64).mean(axis=1)
        figures, change = records[number], changes(steps[number])
        noise = noise_of(
            session.folder / figures.record.file,
            (change.world or world).body,
            expected_counts(world, steps[number], change),
            _patches_px(result, figures, world, change, cells_mm),
            lut.samples.shape[2],
        )
        means -= noise / figures.paper.field.at(cells_mm)
        error[number] = means / level[number] - 1
    brightness = (lut.white / white).max(axis=1)
    unfit = [cell.colour for cell in lut.provenance.unfit]
    fit = np.ones(len(codes), dtype=np.bool_)
    fit[unfit] = False
    offset = offsets_px(result.figures.registration, world, cells_mm, session.folder / records[0].record.file)
    light_uncertainty = lut.truth_uncertainty_deg
    assert light_uncertainty is not None
    light = angles_deg(white, lut.white)
    return TableTruth(
        light, light_uncertainty, patch_uncertainty(lut), brightness / np.median(brightness), level, error, fit, offset
    )


def patch_uncertainty(lut: Lut) -> _Array:
    """Return the expanded relative uncertainty (k = 2) of the patch means reported by a LUT, (C, 3)."""
    return np.loadtxt(lut.folder / CELLS, delimiter=",", skiprows=1)[:, 1:]


def noise_of(
    file: Path,
    body: Body,
    expected: npt.NDArray[np.float32],
    patches_px: _Array,
    samples: int,
) -> _Array:
    """Return the noise contained in the patch means of one frame, (C, 3) counts.

    `expected`: counts above black without noise, (rows, columns). `places_px`: patch positions (C, 2), half-size px.
    """
    from cv2 import BORDER_REPLICATE, boxFilter

    mosaic = read_raw(file)
    top, left, height, width = body.visible
    noise = mosaic.sensor[top : top + height, left : left + width].astype(np.float32) - body.black - expected
    first_row, first_column = mosaic.visible.top - top, mosaic.visible.left - left
    rows, columns = mosaic.block_planes().shape[2:]
    side = round(samples**0.5)
    sites = sites_at(patches_px, (rows, columns), side)
    inside = sites.inside
    means = np.zeros((len(patches_px), 3))
    for block_index, letter in enumerate(mosaic.pattern):
        row, column = first_row + block_index // 2, first_column + block_index % 2
        plane = np.ascontiguousarray(noise[row::2, column::2][:rows, :columns])
        boxed = np.asarray(boxFilter(plane, -1, (side, side), borderType=BORDER_REPLICATE))
        patch_noise = boxed[sites.rows[inside], sites.columns[inside]] / mosaic.pattern.count(letter)
        means[inside, CHANNELS.index(letter)] += patch_noise
    return means


def _patches_px(
    result: BuildResult, figures: FrameMeasurements, world: World, change: FrameChange, cells_mm: _Array
) -> _Array:
    """Return where the patches were sampled in a frame (C, 2); approximate after a new registration."""
    registration, is_reregistered = (
        result.figures.registration,
        any(frame.reregistered for frame in result.figures.frames),
    )
    if not is_reregistered or change.situation == UNDISTURBED:
        is_still = math.hypot(figures.shift.dx, figures.shift.dy) <= STILL_PX
        return (registration if is_still else registration.shifted(figures.shift.dx, figures.shift.dy)).to_pixels(
            cells_mm
        )
    offset_px = registration.to_pixels(cells_mm) - world.project(cells_mm)
    return offset_px + world.project(cells_mm, situation=change.situation)


def offsets_px(registration: Registration, world: World, points_mm: _Array, file: Path) -> _Array:
    """Return registered minus true positions of chart points by channel, (3, N, 2)."""
    mosaic = read_raw(file)
    visible = world.body.visible
    crop = np.array([mosaic.visible.left - visible.left, mosaic.visible.top - visible.top]) / 2
    return np.stack(
        [
            registered_px(registration, points_mm, channel) - (world.project(points_mm, channel) - crop)
            for channel in CHANNELS
        ]
    )


def registered_px(registration: Registration, points_mm: _Array, channel: str) -> _Array:
    """Return the registered positions of chart points in a channel (N, 2); older registrations have one for all."""
    to_pixels: Callable[..., _Array] = registration.to_pixels
    return (
        to_pixels(points_mm, channel) if "channel" in inspect.signature(to_pixels).parameters else to_pixels(points_mm)
    )
