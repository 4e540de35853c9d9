"""Check a rig before the session: do all devices answer, is the chart there, sharp, whole and well exposed.

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
from acquisition.framing.finding import Framing, find_chart
from acquisition.framing.sharpness import MAX_BLUR_PX, blur_px
from acquisition.framing.tags import MIN_MODULE_PX
from acquisition.judge.exposure import measure_exposure, refusal
from acquisition.lights.illuminations import load_illuminations
from acquisition.run.devices import Devices
from acquisition.run.lamp import make_ready
from acquisition.run.patience import Patience
from acquisition.run.rig.opening import open_rig
from acquisition.run.shutter import exposure_advice, light_period_s
from acquisition.session.plan import FrameKind
from drivers.camera import capture, keep_awake
from drivers.presenter import BLACK, WHITE, Colour, ReportsWarnings
from drivers.raw.rawfile import Mosaic, read_raw
from foundation.errors import RegistrationError
from foundation.files import write_whole


@dataclass(frozen=True)
class CheckReport:
    """What was found, line by line, and what is not good enough, a sentence each with its remedy."""

    lines: tuple[str, ...]
    faults: tuple[str, ...]


def check_lab(
    settings: LabSettings,
    picture: Path | None,
    announce: Callable[[str], None] = lambda sentence: None,
    corners: Corners | None = None,
) -> CheckReport:
    """Check the rig that the settings name; record nothing.

    Parameters
    ----------
    picture
        Where to draw what was found on the white frame, PNG; None for nowhere.
    announce
        Called with a sentence when a long wait begins.
    corners
        Of the field of a chart without tags, as given by hand, half-size px; `acquisition.framing.corners`.

    Raises
    ------
    InputError, DeviceError
        The settings or a device make a check impossible.
    """
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    lines = [f"lights      {len(lights)} in {settings.illuminations.name}"]
    with open_rig(settings, chart) as devices, tempfile.TemporaryDirectory() as scratch:
        lines += _make_devices_ready(devices, settings, announce)
        offered = devices.camera.shutter_speeds()
        shown: list[tuple[FrameKind, Colour]] = [("dark", BLACK), ("white", WHITE)]
        mosaics: dict[FrameKind, Mosaic] = {
            kind: _take(devices, colour, settings, Path(scratch) / kind) for kind, colour in shown
        }
    faults = [
        f"{kind} frame: {reason}"
        for kind, mosaic in mosaics.items()
        if (reason := refusal(measure_exposure(mosaic), kind, settings.limits))
    ]
    white = mosaics["white"]
    lines.append(_exposure_line(white, settings, offered))
    try:
        framing = find_chart(white, chart, "the white frame", corners)
    except RegistrationError as error:
        framing = None
        faults.append(f"{error}; see {picture}" if picture is not None else str(error))
    else:
        blur = blur_px(framing)
        lines += _framing_lines(framing, blur)
        faults += _framing_faults(framing, blur)
    if picture is not None:
        write_whole(picture, annotated_png(white, chart, framing))
        lines.append(f"picture     {picture}")
    return CheckReport(tuple(lines), tuple(faults))


def _make_devices_ready(devices: Devices, settings: LabSettings, announce: Callable[[str], None]) -> list[str]:
    """Make every device ready for a frame; return a line about each."""
    body = devices.camera.identity()
    name = body.model if body.model.startswith(body.maker.split()[0]) else f"{body.maker} {body.model}"
    lines = [f"camera      {name}, serial {body.serial}"]
    if isinstance(devices.presenter, ReportsWarnings):
        lines += [f"picture     {warning}" for warning in devices.presenter.warnings()]
    devices.camera.configure(settings.camera.exposure)
    if devices.projector is not None:
        patience = Patience(
            devices.clock,
            0,
            lambda what, sentence: announce(f"{what}: {sentence}"),
            lambda: keep_awake(devices.camera),
        )
        make_ready(devices.projector, settings.sequence, patience)
        identity = devices.projector.identity()
        hours = ", ".join(f"{lamp.hours} h" for lamp in devices.projector.lamps()) or "no lamp"
        lines.append(f"projector   {identity.maker} {identity.model} {identity.name}, {hours}")
    return lines


def _take(devices: Devices, colour: Colour, settings: LabSettings, path: Path) -> Mosaic:
    """Photograph one colour."""
    devices.presenter.show(colour)
    devices.clock.sleep(settings.sequence.settle_s)
    with path.open("wb") as stream:
        capture(devices.camera, stream)
    return read_raw(path)


def _exposure_line(white: Mosaic, settings: LabSettings, offered_s: tuple[float, ...]) -> str:
    exposure = measure_exposure(white)
    line = f"exposure    paper white at {exposure.level:.0%} of saturation, {exposure.clipped:.2%} clipped"
    if settings.rig == "replay":
        # A recording cannot be exposed anew.
        return line
    advice = exposure_advice(exposure.level, settings.camera.shutter_s, offered_s, _light_period_s(settings))
    return f"{line}; {advice}" if advice else line


def _light_period_s(settings: LabSettings) -> float:
    """Return the seconds after which the light repeats: that of the simulated room's wheel where it has one."""
    wheel_hz = float(settings.simulated.room.get("wheel_hz", 0)) if settings.rig == "simulated" else 0.0
    return 1 / wheel_hz if wheel_hz else light_period_s(settings.lab.projector)


def _framing_lines(framing: Framing, blur: float) -> list[str]:
    """Return what was found of the chart and how sharp it is; `blur` in half-size px."""
    total = len(framing.tags) + len(framing.missing)
    found = f"{len(framing.tags)} of {total} tags" if framing.field is None else "no tags, field of cells found"
    module = "" if framing.field is not None else f", tag modules {framing.module_px:.1f} px"
    return [
        f"chart       {found}, turned by {framing.rotation_deg:+.1f}°, fills {framing.fill:.0%} of the frame",
        f"sharpness   blur σ {blur:.2f} px{module} (half-size pixels)",
    ]


def _framing_faults(framing: Framing, blur: float) -> list[str]:
    """Return what of place, size and sharpness is not good enough, each with its remedy; `blur` in half-size px."""
    faults: list[str] = []
    if not framing.inside:
        faults.append("the sheet does not lie in the frame with all four corners; move the camera back or turn it")
    if framing.module_px < MIN_MODULE_PX:
        faults.append(
            f"a tag module is {framing.module_px:.1f} px wide, at least {MIN_MODULE_PX:g} px expected; "
            "bring the camera nearer"
        )
    if not blur <= MAX_BLUR_PX:
        faults.append(
            f"the picture is blurred: σ is {blur:.2f} px, at most {MAX_BLUR_PX:g} px expected; focus the lens, and see "
            "that camera and chart stand still"
        )
    return faults
