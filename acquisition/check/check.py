"""Check a rig before the session: every device asked, frames taken and thrown away, a verdict on each thing.

Takes 10 to 20 frames; records nothing. The lamp is switched on if it was off, and stays on, which is said; a muted
picture is shown.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acquisition.check.camera import (
    judge_chart,
    judge_clipping,
    judge_disk,
    judge_hot,
    judge_linearity,
    judge_noise_reduction,
    judge_sharpness,
    judge_size,
    judge_supplies,
    judge_tilt,
    judge_turn,
)
from acquisition.check.findings import CheckReport, Finding, not_checked, not_checked_all
from acquisition.check.forecast import Forecast, darkest_counts, forecast_findings, measure_table, smallest_cell_px
from acquisition.check.frames import (
    ChartMeasurements,
    CheckFrames,
    Photographer,
    judge_exposure,
    look,
    mean_levels,
    measure_chart,
    points_of,
)
from acquisition.check.light_and_print import (
    judge_evenness,
    judge_flicker,
    judge_primaries,
    judge_print,
    judge_room_light,
)
from acquisition.judge.exposure import disagreement
from acquisition.run.asking import ask_all
from acquisition.run.devices import Devices
from acquisition.run.lamp import make_ready, reported_error
from acquisition.run.patience import Patience
from acquisition.run.planning.work import planned_steps
from acquisition.run.rig.opening import open_rig
from acquisition.run.shutter import period_s
from calibration.figures.figure import CheckMeasurements
from calibration.figures.light import ADDITIVITY, LINEARITY
from drivers.camera import keep_awake
from drivers.presenter import Colour, ReportsWarnings
from drivers.projector import Power, Projector, Severity
from experiment.chart.model import Chart, load_chart
from experiment.config import LabSettings
from experiment.framing.corners import Corners
from experiment.lights.illuminations import Illumination, load_illuminations
from foundation.errors import DeviceError, counted
from foundation.files import write_whole

LEAST_WHITE = 100.0
"""Counts of paper under white in the weakest channel, from which on lights are compared with it."""

_OF_PRIMARIES = ("brightest light", ADDITIVITY.name, "flicker", "brightness")
"""What is judged by frames of the primaries, and of white again."""

CLIPPED = "white is clipped at every shutter time that was tried"
"""Why nothing can be said of the light."""


@dataclass(frozen=True)
class CheckOptions:
    """What is asked of a check.

    - `picture`: where to draw what was found, PNG; None for nowhere.
    - `corners`: of the field of a chart without tags, as given by hand, half-size px; `experiment.framing.corners`.
    - `linearity`: whether to take a series of exposures that shows the sensor's linearity and noise.
    - `session`: where the session is to lie, for the disk's free space; the settings' folder if not given.
    """

    picture: Path | None = None
    corners: Corners | None = None
    linearity: bool = False
    session: Path | None = None


def check_lab(
    settings: LabSettings,
    options: CheckOptions | None = None,
    announce: Callable[[str], None] = lambda sentence: None,
) -> CheckReport:
    """Check the rig that the settings name; record nothing."""
    options = options or CheckOptions()
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    frames = len(planned_steps(settings, lights))
    lines = [f"lights      {len(lights)} in {settings.illuminations.name}, {counted(frames, 'frame')} of a session"]
    with open_rig(settings, chart) as devices, tempfile.TemporaryDirectory() as scratch:
        described, screen = _make_devices_ready(devices, settings, announce)
        lines += described
        camera = Photographer(devices, settings, Path(scratch))
        seen = look(
            camera, settings, chart, devices.camera.shutter_speeds(), period_s(settings), options.corners,
            options.linearity, announce,
        )  # fmt: skip
        supplies = judge_supplies(devices.camera, frames, seen.first.size)
    figures = None if seen.chart is None else measure_chart(seen, seen.chart, chart)
    recorded = settings.rig == "replay"
    findings = [
        *_exposure_findings(seen, settings, recorded),
        *_chart_findings(seen, figures, chart, options),
        *_light_findings(seen, figures, chart, bool(lights), settings.judge.dark_percent),
        *_sensor_findings(seen, camera.timings, figures, chart, options),
        *screen,
        judge_disk(options.session or Path(settings.file).parent, frames, seen.first.size),
        *supplies,
    ]
    if seen.used_s != seen.first.shutter_s:
        lines.append(f"frames      all but exposure and clipping judged at {seen.used_s:.4g} s")
    table = _forecast(seen, chart, lights)
    why_not = "the chart was not found" if seen.chart is None else "" if seen.usable else CLIPPED
    findings += forecast_findings(table, chart, why_not)
    outcome = None if seen.chart is None else table.outcome
    report = CheckReport(tuple(lines), tuple(findings), outcome, table.figures, table.not_known)
    if options.picture is not None:
        from acquisition.check.picture import check_png

        write_whole(options.picture, check_png(seen, figures, chart, report))
    return report


def _exposure_findings(seen: CheckFrames, settings: LabSettings, recorded: bool) -> list[Finding]:
    findings = [
        judge_exposure(seen.trials, seen.saturation, seen.times_s, period_s(settings), recorded),
        judge_clipping(
            seen.first.mosaic,
            seen.first.shutter_s,
            seen.saturation.counts,
            settings.limits.clipped_percent,
            seen.chart and seen.chart.place,
        ),
    ]
    differs = None if recorded else disagreement(seen.first.mosaic, settings.camera.exposure)
    if differs is not None:
        findings.append(Finding("settings", "fault", differs, remedy="set the mode dial to M and touch no other"))
    return findings


def _chart_findings(
    seen: CheckFrames, figures: ChartMeasurements | None, chart: Chart, options: CheckOptions
) -> list[Finding]:
    if figures is None:
        look_at = "" if options.picture is None else f"see {options.picture}"
        names = ("evenness", "colour evenness", "sharpness", "turn", "tilt", "size", "stains")
        why = "the chart was not found"
        return [Finding("chart", "fault", seen.trouble or why, remedy=look_at), *not_checked_all(names, why)]
    framing, place = figures.placed.framing, figures.placed.place
    print_found = judge_print(figures.state, chart, place.matched)
    evenness, coloured = judge_evenness(figures.light, chart)
    if evenness.grade != "good" and print_found.grade in ("fault", "remark"):
        said = f"{print_found.said}; the light is so uneven that it may be an edge of the light"
        print_found = replace(print_found, said=said)
    lit = [print_found, evenness, coloured]
    if not seen.usable:
        lit = not_checked_all(("stains", "evenness", "colour evenness"), CLIPPED)
    return [
        judge_chart(framing, chart),
        *lit,
        judge_sharpness(figures.blur, chart, framing.module_px, smallest_cell_px(chart, figures.placed)),
        judge_turn(framing),
        judge_tilt(framing, chart, seen.focal_px),
        judge_size(framing, chart, place),
    ]


def _forecast(seen: CheckFrames, chart: Chart, lights: Sequence[Illumination]) -> Forecast:
    """Return what can be said of the table at the settings' exposure."""
    if seen.chart is None:
        return Forecast()
    if not seen.usable:
        return Forecast.of(CheckMeasurements(brightest_share=1.0))
    measured = measure_table(chart, seen.chart, seen.whites, seen.dark, seen.saturation.counts)
    ratio = seen.first.shutter_s / seen.used_s
    if measured.brightest_share is not None:
        measured = replace(measured, brightest_share=measured.brightest_share * ratio)
    levels = seen.primaries
    if levels is not None:
        measured = replace(measured, darkest_counts=darkest_counts(lights, levels, ratio))
        if float(levels["white"].min()) >= LEAST_WHITE:
            alone = np.sum([levels[name] for name in ("red", "green", "blue")], axis=0)
            off = float(np.abs((alone - 2 * levels["black"]) / levels["white"] - 1).max())
            measured = replace(measured, not_additive=off)
    return Forecast.of(measured)


def _light_findings(
    seen: CheckFrames, figures: ChartMeasurements | None, chart: Chart, plan_has: bool, dark_percent: float
) -> list[Finding]:
    if not seen.usable:
        return not_checked_all(("room light", *_OF_PRIMARIES), CLIPPED)
    if figures is None:
        findings = [not_checked("room light", "the chart was not found")]
    else:
        points, white = points_of(chart), np.concatenate([figures.cells.mean, figures.references.mean])
        clipped = np.concatenate([figures.cells.clipped, figures.references.clipped])
        white = np.where(clipped[:, None], np.nan, white)
        dark, muted = (
            None if shot is None else mean_levels((shot,), figures.placed, points, seen.saturation.counts).mean
            for shot in (seen.dark, seen.muted)
        )
        assert dark is not None
        room = judge_room_light(chart, points, white, dark, muted, seen.why_not_muted)
        findings = [_as_the_run_refuses(room, dark_percent)]
    if seen.primaries is None:
        return [*findings, *not_checked_all(_OF_PRIMARIES, "a recording cannot be exposed anew")]
    if float(seen.primaries["white"].min()) < LEAST_WHITE:
        return [*findings, *not_checked_all(_OF_PRIMARIES, "white is too dim")]
    return [*findings, *judge_primaries(seen.primaries, plan_has), *judge_flicker(seen.white_levels, seen.used_s)]


def _as_the_run_refuses(found: Finding, dark_percent: float) -> Finding:
    """Return the finding on the room's light with the run's own limit for a fault."""
    if found.value is None or found.grade == "good":
        return found
    beyond = found.value > dark_percent / 100
    return replace(found, grade="fault" if beyond else "remark", tolerable=(None, dark_percent / 100))


def _sensor_findings(
    seen: CheckFrames,
    timings: list[tuple[float, float]],
    figures: ChartMeasurements | None,
    chart: Chart,
    options: CheckOptions,
) -> list[Finding]:
    share = 0.0
    if figures is not None:
        dark = mean_levels((seen.dark,), figures.placed, chart.centres_mm, seen.saturation.counts).mean
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = dark / np.where(figures.cells.mean > 300, figures.cells.mean, np.nan)
        share = float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else 0.0
    hot = judge_hot(seen.dark.mosaic, share, seen.whites[0].mosaic)
    findings = [
        hot if seen.usable and figures is not None else not_checked("hot photosites", "white does not show the print"),
        judge_noise_reduction(timings),
    ]
    if not options.linearity:
        return findings
    if seen.series is None:
        why = "the chart was not found" if seen.chart is None else "a recording cannot be exposed anew"
        return [*findings, *not_checked_all((LINEARITY.name, "photon transfer"), why)]
    series = seen.series
    return [*findings, *judge_linearity(series.seen, series.times_s, series.transfer)]


def _make_devices_ready(
    devices: Devices, settings: LabSettings, announce: Callable[[str], None]
) -> tuple[list[str], list[Finding]]:
    """Make every device ready for a frame; return a line about each, and what screen and projector report."""
    projector = devices.projector
    questions: dict[str, Callable[[], object]] = {
        "camera": lambda: (devices.camera.identity(), devices.camera.configure(settings.camera.exposure)),
        "display": lambda: devices.presenter.show(Colour(0, 0, 0)),
    }
    if projector is not None:
        questions["projector"] = lambda: (projector.identity(), projector.power(), _require_sound(projector))
    ask_all(questions)
    body = devices.camera.identity()
    lines = [f"camera      {body.name}, serial {body.serial}"]
    warnings = devices.presenter.warnings() if isinstance(devices.presenter, ReportsWarnings) else ()
    findings = [Finding("screen", "remark", warning) for warning in warnings]
    if projector is None:
        lines.append("projector   not under control: see to its lamp yourself")
        return lines, findings
    before = _state(projector)
    patience = Patience(
        devices.clock, 0, lambda what, sentence: announce(f"{what}: {sentence}"), lambda: keep_awake(devices.camera)
    )
    make_ready(projector, settings.sequence, patience)
    identity = projector.identity()
    hours = ", ".join(f"{lamp.hours} h" for lamp in projector.lamps()) or "no lamp"
    lines.append(f"projector   {identity.maker} {identity.model} {identity.name}, {hours}; {before}")
    parts = [fault.part for fault in projector.faults() if fault.severity is Severity.WARNING]
    if parts:
        said = f"the projector warns of its {', '.join(parts)}"
        findings.append(Finding("projector", "remark", said, remedy="look at its display before the session"))
    return lines, findings


def _require_sound(projector: Projector) -> None:
    """Require that a projector reports no error of its parts; a DeviceFault names them."""
    if (fault := reported_error(projector)) is not None:
        raise fault


def _state(projector: Projector) -> str:
    """Return in which state the projector was found, and in which it is left."""
    try:
        if projector.power() is not Power.ON:
            return "its lamp was off; it is switched on, and stays on when the check is over"
        return "it was muted, and shows its picture now" if projector.muted() else "its lamp was on, and stays on"
    except DeviceError:
        return "it is switched on, and stays on"
