"""A lab for these tests: a chart in front of a simulated body, and sessions taken in it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.sessions import record_session
from calibration.registration.register import Registration, register
from calibration.report.report import report_json
from calibration.table.lut import REPORT_JSON
from calibration.verdict import BuildResult
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE, Colour
from drivers.raw.rawfile import Mosaic, read_raw
from experiment.chart.layout import A_SERIES_MM, design_chart
from experiment.chart.model import Chart
from experiment.chart.printing import drawing
from experiment.framing.field import field_mm
from experiment.lights import Illuminant, plan_illuminants
from experiment.session.folder import Session
from experiment.session.records import ACCEPTED, SessionStep
from sim.camera.film import write_dng
from sim.world.disturbances import UNDISTURBED, Situation
from sim.world.rendering import Print
from sim.world.sensors import BODIES, Body, Rectangle
from sim.world.world import Room, World

SETTINGS = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
# Software printed in the margin of charts; another version would change the picture.
SOFTWARE = "croplab 0.1.0"
Paint = Callable[[npt.NDArray[np.uint16]], None]
TAKEN_AT = datetime(2024, 3, 1, 9, 0, tzinfo=UTC)


@dataclass(frozen=True, eq=False)
class Lab:
    """A chart hung in a simulated room."""

    chart: Chart
    world: World

    def dng(
        self,
        colour: Colour = WHITE,
        key: int = 1,
        settings: ExposureSettings = SETTINGS,
        paint: Paint | None = None,
        *,
        stated: ExposureSettings | None = None,
        serial: str = "000000000000",
        lamp: float = 1.0,
        situation: Situation = UNDISTURBED,
    ) -> bytes:
        """Return a frame's file.

        `paint` may change the sensor's counts; `stated` is the exposure recorded in the file, if it differs.
        """
        counts = self.world.expose(colour, settings, key=(key,), lamp=lamp, situation=situation)
        if paint is not None:
            paint(counts)
        stream = BytesIO()
        recorded = settings if stated is None else stated
        write_dng(stream, counts, self.world.body, settings=recorded, taken_at=TAKEN_AT, serial=serial)
        return stream.getvalue()

    def mosaic(
        self,
        folder: Path,
        colour: Colour = WHITE,
        key: int = 1,
        settings: ExposureSettings = SETTINGS,
        paint: Paint | None = None,
    ) -> Mosaic:
        """Return a frame as read from its file."""
        path = folder / f"{key}.dng"
        path.write_bytes(self.dng(colour, key, settings, paint))
        return read_raw(path)

    def truth_px(self, points_mm: npt.NDArray[np.float64], mosaic: Mosaic) -> npt.NDArray[np.float64]:
        """Return the true positions of points, half-size px of the decoded mosaic."""
        visible = self.world.body.visible
        aside = np.array([mosaic.visible.left - visible.left, mosaic.visible.top - visible.top]) / 2
        return self.world.project(points_mm) - aside

    def corners_px(self, mosaic: Mosaic) -> npt.NDArray[np.float64] | None:
        """Return corners as given by a person, whole raw pixels with small errors; None for a chart with tags."""
        if self.chart.tags:
            return None
        return (self.truth_px(field_mm(self.chart), mosaic) + np.array([(4, -3), (-3, 2), (2, 4), (-4, -2)])).round()

    def miss_px(self, mosaic: Mosaic) -> npt.NDArray[np.float64]:
        """Return the distance of registered cells from the truth, px."""
        places = register(mosaic, self.chart, corners=self.corners_px(mosaic)).to_pixels(self.chart.centres_mm)
        return np.linalg.norm(places - self.truth_px(self.chart.centres_mm, mosaic), axis=1)


@cache
def designed(bits: int, page: str, seed: int) -> tuple[Chart, Print]:
    chart = replace(design_chart(bits, A_SERIES_MM[page], seed), software=SOFTWARE)
    picture = drawing(chart)
    return chart, Print(picture.page_mm, picture.rectangles_mm, picture.rgb)


def hang(bits: int = 3, page: str = "A5", body: str = "Test", seed: int = 1, room: Room | None = None) -> Lab:
    """Return a lab; paper of a small page is less wavy than the default."""
    chart, sheet = designed(bits, page, seed)
    return Lab(chart, World(sheet, BODIES[body], Room(waviness_mm=0.5) if room is None else room))


def hang_chart(chart: Chart, body: str | Body, room: Room) -> Lab:
    """Return a lab with the given chart."""
    chart = replace(chart, software=SOFTWARE)
    picture = drawing(chart)
    seen_by = BODIES[body] if isinstance(body, str) else body
    return Lab(chart, World(Print(picture.page_mm, picture.rectangles_mm, picture.rgb), seen_by, room))


# Half the sides of an EOS 550D: ten times the photosites of the Test body.
QUARTER = replace(
    BODIES["EOS 550D"],
    sensor=(1784, 2742),
    visible=Rectangle(51, 142, 1733, 2600),
    masked=(Rectangle(0, 0, 1784, 140),),
)


def take(
    lab: Lab,
    folder: Path,
    lights: Sequence[Illuminant],
    every: int = 25,
    frame: Callable[[SessionStep], bytes] | None = None,
    verdict: Callable[[SessionStep], str] | None = None,
) -> Session:
    """Return an open session with an accepted frame for every step of the plan."""

    def planned(step: SessionStep) -> bytes:
        return lab.dng(step.colour, step.number)

    def reason(step: SessionStep) -> str | None:
        return "as the test asks" if verdict is not None and verdict(step) != ACCEPTED else None

    return record_session(folder, lab.chart, lights, frame or planned, every=every, reason=reason)


def figures_alone(result: BuildResult, session: Session, folder: Path) -> None:
    """Write a report without its page, whose pictures take seconds."""
    (folder / REPORT_JSON).write_text(json.dumps(report_json(result)))


@contextmanager
def blank_pictures() -> Generator[None]:
    """Leave the pictures of reports blank; drawing them takes three times as long as a small build."""

    def blank(draw: Callable[..., None], *arguments: object, inches: object) -> tuple[bytes, ...]:
        return (b"<svg></svg>",)

    with pytest.MonkeyPatch.context() as patched:
        for page in ("calibration.report.report", "calibration.comparison.report"):
            patched.setattr(f"{page}.draw_panels", blank)
        yield


@pytest.fixture
def lens_unmeasured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the measurement of the lens, which takes a third of a small build."""

    def unsuitable(chart: Chart) -> str:
        return "not measured in this test"

    for module in ("baseline", "table_figures"):
        monkeypatch.setattr(f"calibration.pipeline.{module}.unsuitable", unsuitable)


# Size of stored renderings: sixteen of the Test body.
RENDERED_BYTES = 100_000_000

Rendering = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
_rendered: dict[tuple[object, ...], Rendering] = {}

# Number of frames with stored registration.
REGISTERED_FRAMES = 8

_registered: dict[tuple[object, ...], Registration] = {}


def registered_once(
    mosaic: Mosaic, chart: Chart, what: str, corners: npt.ArrayLike | None, near: Registration | None
) -> Registration:
    """Register equal frames once; all builds of a session share the first frame."""
    counts = hashlib.sha256(mosaic.sensor.tobytes()).digest()
    key = (counts, mosaic.pattern, mosaic.black.tobytes(), mosaic.visible, mosaic.masked, chart.sha256, str(corners))
    if near is not None or key not in _registered:
        result = register(mosaic, chart, what, corners, near)
        if near is not None:
            return result
        _registered[key] = result
        while len(_registered) > REGISTERED_FRAMES:
            del _registered[next(iter(_registered))]
    return _registered[key]


@pytest.fixture(scope="module", autouse=True)
def rendered_once() -> Generator[None]:
    """Render equal worlds, and register equal frames, once per process; hundreds of tests share them."""
    render = World._render_new

    def kept(self: World, situation: Situation) -> Rendering:
        sheet = self.sheet
        # Light that is added, the wheel and hot photosites come with the exposure.
        room = replace(self.room, ambient=0.0, black_leak=0.0, hot_per_million=0.0, wheel_hz=0.0)
        drawn = hashlib.sha256(sheet.rectangles_mm.tobytes() + sheet.rgb.tobytes()).digest()
        # A test may put stain, fold or camera elsewhere than the room says.
        view = self.view
        view_key = (view.rotation.tobytes(), view.distance_mm, view.focal_px, view.centre_px, view.distortion)
        marks = (self.stain, self.fold)
        key = (type(self), self.body, room, marks, view_key, sheet.page_mm, drawn, situation.view)
        # The one that was asked for last is the last to go.
        _rendered[key] = result = _rendered.pop(key, None) or render(self, situation)
        for array in result:
            array.flags.writeable = False
        while sum(light.nbytes for light, _ in _rendered.values()) > RENDERED_BYTES:
            del _rendered[next(iter(_rendered))]
        return result

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(World, "_render_new", kept)
        patched.setattr("calibration.pipeline.measuring.register", registered_once)
        yield


def renumbered(lights: Sequence[Illuminant]) -> tuple[Illuminant, ...]:
    """Return lights numbered from 0."""
    return tuple(replace(light, index=index) for index, light in enumerate(lights))


LIGHTS = plan_illuminants(3, (2500, 4500, 6500))
