"""A look before the session: do all devices answer, is the chart there, sharp, whole and well exposed.

Takes one frame under white and one under black into a temporary folder and keeps neither.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from acquisition.chart.model import load_chart
from acquisition.config import LabSettings
from acquisition.framing.annotated import annotated_png
from acquisition.framing.corners import Corners
from acquisition.framing.sharpness import blur_px
from acquisition.framing.tags import MIN_MODULE_PX, Framing, find_chart
from acquisition.lights.illuminations import load_illuminations
from acquisition.run.exposure import measure_exposure, refusal
from acquisition.run.lamp import make_ready
from acquisition.run.rig import open_rig
from acquisition.run.sequencer import Devices
from acquisition.session.folder import FrameKind
from drivers.camera import keep_awake
from drivers.presenter import BLACK, WHITE, Colour, SelfDoubting
from drivers.raw.rawfile import Mosaic, read_raw
from foundation.errors import RegistrationError
from foundation.files import write_whole

TARGET_LEVEL = 0.75
"""Paper white under white as a share of the sensor's range: below the 0.8 at which a session is sure not to clip."""
LEVELS = (0.3, 0.8)
"""Between these shares the exposure is left as it is."""
MAX_BLUR_PX = 1.0
"""σ beyond which the 25 samples of a cell take in light from its neighbours (more than 1 % at 10 px a cell)."""
DLP_TURN_S = 1 / 60


@dataclass(frozen=True)
class CheckReport:
    """What was seen, line by line, and what would not do."""

    lines: tuple[str, ...]
    faults: tuple[str, ...]


def check_lab(
    settings: LabSettings,
    picture: Path | None,
    announce: Callable[[str], None] = lambda sentence: None,
    corners: Corners | None = None,
) -> CheckReport:
    """Look through the rig that the settings name; record nothing.

    Parameters
    ----------
    picture
        Where to draw what was found on the white frame, PNG; None for nowhere.
    announce
        Called with a sentence when a long wait begins.
    corners
        Of the field of a chart without tags, as told by hand; `acquisition.framing.corners`.

    Raises
    ------
    InputError, DeviceError
        The settings or a device make a look impossible.
    """
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    lines = [f"lights      {len(lights)} in {settings.illuminations.name}"]
    faults: list[str] = []
    with open_rig(settings, chart) as devices, tempfile.TemporaryDirectory() as scratch:
        body = devices.camera.identity()
        name = body.model if body.model.startswith(body.maker.split()[0]) else f"{body.maker} {body.model}"
        lines.append(f"camera      {name}, serial {body.serial}")
        if isinstance(devices.presenter, SelfDoubting):
            lines.extend(f"picture     {warning}" for warning in devices.presenter.warnings())
        devices.camera.configure(settings.camera.exposure)
        if devices.projector is not None:
            make_ready(
                devices.projector,
                devices.clock,
                settings.sequence,
                lambda: keep_awake(devices.camera),
                lambda what, sentence: announce(f"{what}: {sentence}"),
            )
            beamer = devices.projector.identity()
            hours = ", ".join(f"{lamp.hours} h" for lamp in devices.projector.lamps()) or "no lamp"
            lines.append(f"projector   {beamer.maker} {beamer.model} {beamer.name}, {hours}")
        frames: list[tuple[FrameKind, Colour]] = [("dark", BLACK), ("white", WHITE)]
        mosaics: dict[FrameKind, Mosaic] = {
            kind: _look(devices, colour, settings, Path(scratch) / kind) for kind, colour in frames
        }
    for kind, mosaic in mosaics.items():
        reason = refusal(measure_exposure(mosaic), kind, settings.limits)
        if reason:
            faults.append(f"{kind} frame: {reason}")
    white = mosaics["white"]
    _judge_exposure(white, settings, lines)
    try:
        framing = find_chart(white, chart, "the white frame", corners)
    except RegistrationError as error:
        faults.append(f"{error}; see {picture}" if picture is not None else str(error))
        framing = None
    else:
        _judge_framing(framing, lines, faults)
    if picture is not None:
        write_whole(picture, annotated_png(white, chart, framing))
        lines.append(f"picture     {picture}")
    return CheckReport(tuple(lines), tuple(faults))


def _look(devices: Devices, colour: Colour, settings: LabSettings, path: Path) -> Mosaic:
    devices.presenter.show(colour)
    devices.clock.sleep(settings.sequence.settle_s)
    with path.open("wb") as stream:
        devices.camera.capture(stream)
    return read_raw(path)


def _judge_exposure(white: Mosaic, settings: LabSettings, lines: list[str]) -> None:
    exposure = measure_exposure(white)
    line = f"exposure    paper white at {exposure.level:.0%} of saturation, {exposure.clipped:.2%} clipped"
    if not LEVELS[0] <= exposure.level <= LEVELS[1]:
        better = settings.camera.shutter_s * TARGET_LEVEL / max(exposure.level, 1e-3)
        better = max(1, round(better / DLP_TURN_S)) * DLP_TURN_S
        line += f"; {LEVELS[0]:.0%} to {LEVELS[1]:.0%} wanted, try shutter_s = {better:.3g}"
    lines.append(line)


def _judge_framing(framing: Framing, lines: list[str], faults: list[str]) -> None:
    total = len(framing.tags) + len(framing.missing)
    found = f"{len(framing.tags)} of {total} tags" if framing.field is None else "no tags, field of cells found"
    lines.append(f"chart       {found}, turned by {framing.rotation_deg:+.1f}°, fills {framing.fill:.0%} of the frame")
    blur = blur_px(framing)
    module = "" if framing.field is not None else f", tag modules {framing.module_px:.1f} px"
    lines.append(f"sharpness   blur σ {blur:.2f} px{module} (half-size pixels)")
    if not framing.inside:
        faults.append("the sheet does not lie in the frame with all four corners; move the camera back or turn it")
    if framing.module_px < MIN_MODULE_PX:
        faults.append(
            f"a tag module is {framing.module_px:.1f} px wide, {MIN_MODULE_PX:g} needed; bring the camera nearer"
        )
    if not blur <= MAX_BLUR_PX:
        faults.append(f"the picture is soft: blur σ {blur:.2f} px, {MAX_BLUR_PX:g} allowed; focus the lens")
