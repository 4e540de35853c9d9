"""Check a laboratory before a session (`acquire check`).

The devices are queried, a shutter time is proposed, and trial frames are judged by the figures of `build-lut`. A check
takes about 25 frames into a hidden folder next to LAB.toml and deletes the folder at the end. The lamp is switched on
if it was off, and stays on.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.check.exposure import (
    Photographer,
    Saturation,
    Shot,
    TriedTime,
    best_trial,
    fitting_times,
    judge_exposure,
    measure_level,
    measure_saturation,
    search,
)
from acquisition.check.findings import CheckReport, Finding, judge_value, not_checked
from acquisition.check.picture import check_png
from acquisition.check.supplies import judge_disk, judge_noise_reduction, judge_supplies
from acquisition.check.trial import (
    PRIMARIES,
    Trial,
    measure_trial,
    series_times,
    take_trial,
    trial_lights,
    trial_steps,
)
from acquisition.judge.measure import Anchor, disagreement, refusal
from acquisition.run.devices import Devices, RetryPolicy, ask_all, make_ready, period_s, reported_error
from acquisition.run.plan import planned_steps, projector_state, settings_doubts
from acquisition.run.rig.opening import open_rig
from calibration.figures.light import LEAK_SHARE
from calibration.figures.single_frames import EVENNESS, KEYSTONE, TURN
from calibration.figures.truth import BRIGHTEST_SHARE
from calibration.measurements import TableMeasurements
from calibration.verdict import JudgedValue, detail_and_remedy, explain, positions_text
from drivers.camera import keep_awake
from drivers.presenter import WHITE, Colour, ReportsWarnings
from drivers.projector import Projector, Severity
from drivers.raw.rawfile import frame_black, phases
from experiment.chart.model import Chart, load_chart
from experiment.config import LabSettings
from experiment.framing.field import Corners
from experiment.framing.homography import project
from experiment.lights import load_illuminants
from experiment.measures.exposure import measure_exposure
from experiment.measures.paper import falloff
from experiment.measures.pose import keystone, off_level_deg
from experiment.session.folder import Session
from foundation.errors import RegistrationError, StorageError, counted
from foundation.files import write_atomic
from foundation.folders import bytes_text, free_bytes_at

# If white is in this range of saturation, trial frames have the shutter time of the settings. Otherwise they have the
# best tried shutter time.
USABLE = (0.3, 0.9)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TriedExposures:
    """White frames at the tried shutter times.

    - `first`: white frame at the shutter time of the settings.
    - `trials`: tried shutter times, beginning with the shutter time of the settings.
    - `times_s`: shutter times that can be set, s.
    - `saturation`: measured saturation level.
    """

    first: Shot
    trials: tuple[TriedTime, ...]
    times_s: tuple[float, ...]
    saturation: Saturation

    @property
    def used_s(self) -> float:
        """Shutter time of the trial frames, s."""
        first = self.trials[0]
        is_usable = USABLE[0] <= first.highest <= USABLE[1] and not first.clipped
        return first.shutter_s if is_usable else best_trial(self.trials).shutter_s


def check_lab(
    settings: LabSettings,
    announce: Callable[[str], None] = lambda sentence: None,
    *,
    picture: Path | None = None,
    corners: Corners | None = None,
    linearity: bool = False,
) -> CheckReport:
    """Check the devices and the chart of the settings; record nothing.

    `picture`: PNG file to draw. `corners`: corners of the field of a chart without tags, half-size px. `linearity`:
    also take an exposure series that measures the linearity of the sensor.
    """
    chart = load_chart(settings.chart)
    lights = load_illuminants(settings.illuminations)
    frames = len(planned_steps(settings, lights))
    lines = [f"illuminants {len(lights)} in {settings.illuminations.name}, {counted(frames, 'frame')} in a session"]
    lab_folder = Path(settings.file).parent
    free_bytes_at(lab_folder)
    # The folder is not in /tmp, which may be in memory, because the frames are 0.4 to 0.7 GB.
    with tempfile.TemporaryDirectory(prefix=".check.", dir=lab_folder) as name:
        scratch = Path(name)
        with open_rig(settings, chart) as devices:
            device_lines, screen = _make_devices_ready(devices, settings, announce)
            camera = Photographer(devices, settings, scratch)
            exposure = _try_exposures(camera, settings, chart, devices.camera.shutter_speeds(), announce)
            announce("taking trial frames: white, dark, primaries, grey")
            series = scratch / "series" if linearity else None
            best = best_trial(exposure.trials)
            series_s = series_times(exposure.times_s, best.shutter_s, best.highest) if series else ()
            shots = [camera.take(colour, exposure.used_s) for colour in PRIMARIES.values()]
            primaries = np.array([shot.brightest(99.0) for shot in shots])
            lights = trial_lights(lights, primaries)
            steps = trial_steps(lights)
            _require_space(lab_folder, (len(steps) + len(series_s)) * exposure.first.size)
            session = Session.create(scratch / "trial", settings.to_toml(), chart, lights, steps)
            (scratch / "series").mkdir()
            take_trial(camera, session, exposure.used_s, series_s, scratch / "series")
            camera.restore()
            supplies = judge_supplies(devices.camera, frames, exposure.first.size)
        announce("measuring the trial frames")
        with session:
            trial = measure_trial(session, exposure.saturation, corners, series)
    lines += device_lines
    if exposure.used_s != exposure.first.shutter_s:
        lines.append(
            f"frames      exposed for {exposure.used_s:.4g} s, because white is clipped or dark at the shutter time of "
            "the settings"
        )
    findings = [
        *_exposure_findings(exposure, settings),
        *_figure_findings(trial, settings),
        *_pose_and_light(trial, chart),
        judge_noise_reduction(camera.timings),
        *([not_checked("series", trial.series_trouble)] if trial.series_trouble else []),
        *screen,
        *(Finding("settings", "remark", doubt) for doubt in settings_doubts(settings)),
        judge_disk(lab_folder, frames, exposure.first.size),
        *supplies,
    ]
    values = {row.figure.name: row.value for row in trial.verdict.rows}
    other_shutter_s = exposure.used_s if exposure.used_s != exposure.first.shutter_s else None
    outcome = None if trial.table is None or other_shutter_s is not None else trial.verdict.outcome
    report = CheckReport(tuple(lines), tuple(findings), outcome, values, trial.not_known, other_shutter_s)
    if picture is not None:
        write_atomic(picture, check_png(trial, chart, report))
    return report


def _require_space(folder: Path, needed_bytes: int) -> None:
    if (free_bytes := free_bytes_at(folder)) < needed_bytes:
        raise StorageError(
            f"{bytes_text(free_bytes)} free at {folder}, expected {bytes_text(needed_bytes, up=True)} for the frames "
            "of a check; free space, or give settings on another disk"
        )


def _try_exposures(
    camera: Photographer,
    settings: LabSettings,
    chart: Chart,
    offered_s: Sequence[float],
    announce: Callable[[str], None],
) -> TriedExposures:
    first = camera.take(WHITE)
    if settings.rig == "replay":
        stated_counts, counts = float(first.mosaic.white_level), float(first.mosaic.saturation())
        saturation = Saturation(counts, counts < stated_counts, stated_counts)
        return TriedExposures(first, (measure_level(first, saturation, _paper(first, chart)),), (), saturation)
    # The camera may accept a time of the settings that it does not list.
    times = fitting_times(sorted({*offered_s, settings.camera.shutter_s}) if offered_s else (), period_s(settings))
    announce("measuring the saturation level with white frames of increasing shutter time")
    saturation = measure_saturation(first, lambda seconds: camera.take(WHITE, seconds), times)

    def level(shot: Shot) -> TriedTime:
        return measure_level(shot, saturation, _paper(shot, chart))

    trials = search(level(first), lambda seconds: level(camera.take(WHITE, seconds)), times)
    return TriedExposures(first, trials, tuple(times), saturation)


def _paper(shot: Shot, chart: Chart) -> _Array | None:
    """Return (3,) counts of white paper above black, as measured by `acquire run`; None if no chart is detected."""
    if not chart.tags:
        return None
    black = frame_black(shot.mosaic)
    try:
        anchor = Anchor.from_white(shot.mosaic, black, chart)
    except RegistrationError:
        return None
    level = anchor.paper_level(shot.mosaic, black, phases(shot.mosaic))
    return None if np.isnan(level).any() else level


def _exposure_findings(exposure: TriedExposures, settings: LabSettings) -> list[Finding]:
    first = exposure.first.mosaic
    findings = [judge_exposure(exposure.trials, exposure.saturation, exposure.times_s, period_s(settings))]
    measured = measure_exposure(replace(first, white_level=round(exposure.saturation.counts)))
    reason = refusal(measured, "white", settings.limits)
    is_clipped = 100 * measured.clipped > settings.limits.clipped_percent
    share = f"{measured.clipped:.2%} of the photosites of a white frame are clipped"
    findings.append(Finding("clipping", "fault", reason or "") if is_clipped else Finding("clipping", "good", share))
    if reason is not None and not is_clipped:
        findings.append(Finding("exposure", "fault", reason))
    difference = disagreement(first, settings.camera.exposure)
    if difference is not None:
        findings.append(Finding("settings", "fault", difference, remedy="set the mode dial of the camera to M"))
    return findings


def _figure_findings(trial: Trial, settings: LabSettings) -> list[Finding]:
    if trial.table is None:
        return [Finding("chart", "fault", trial.trouble), not_checked("figures", "the chart was not measured")]
    table = trial.table
    rows = [row for row in trial.verdict.rows if row.figure is not BRIGHTEST_SHARE]
    findings = [_figure_finding(row, table) for row in rows]
    value, allowed = trial.dark_percent, settings.judge.dark_percent
    if value <= allowed:
        return findings
    # `acquire run` refuses dark frames at a lower limit than `build-lut`.
    fault = Finding(
        LEAK_SHARE.name,
        "fault",
        f"the dark frame has {value:.1f} % of the level of white (mean, or brightest 6 % of the frame)",
        value / 100,
        LEAK_SHARE.unit,
        tolerable=(None, allowed / 100),
        reason=f"at most {allowed:g} % allowed (judge.dark_percent): acquire run would refuse the frame",
        remedy=LEAK_SHARE.remedy,
    )
    return [*(finding for finding in findings if finding.name != LEAK_SHARE.name), fault]


def _figure_finding(row: JudgedValue, table: TableMeasurements) -> Finding:
    if row.outcome == "accept":
        return judge_value(row.figure, row.value)
    detail, remedy = detail_and_remedy(row.figure, table)
    cause = explain(row.figure, table)
    if cause is not None and cause.is_known:
        remedy = cause.decision.cause.remedy
        detail += f", probably {cause.decision.cause.description}"
    where = positions_text(cause)
    sentence = f"{row.figure.title}: {row.measured}{detail}{f', {where}' if where else ''}"
    return judge_value(row.figure, row.value, sentence, remedy)


def _pose_and_light(trial: Trial, chart: Chart) -> list[Finding]:
    if trial.table is None:
        return [not_checked(limit.name, "the chart was not measured") for limit in (TURN, KEYSTONE, EVENNESS)]
    table = trial.table
    framing, (width, height) = table.registration.framing, chart.page_mm
    tilt_deg, quarters = off_level_deg(framing.rotation_deg)
    turned = f", in addition to a harmless turn by {90 * quarters}°" if quarters else ""
    across, down = keystone(project(framing.homography, [(0, 0), (width, 0), (width, height), (0, height)]))
    tilt = f"the chart is turned by {tilt_deg:+.1f}° in the image{turned}"
    falloff_rgb = falloff(table.frames[0].paper.field.at(chart.centres_mm))
    return [
        judge_value(TURN, abs(tilt_deg), tilt, details={"turned": quarters}),
        judge_value(KEYSTONE, max(across, down), details={"across": across, "down": down}),
        judge_value(
            EVENNESS,
            float(falloff_rgb.max()),
            f"the darkest position on the chart has {100 * falloff_rgb.max():.0f} % less light than the brightest",
            details={"falloff": falloff_rgb.tolist()},
        ),
    ]


def _make_devices_ready(
    devices: Devices, settings: LabSettings, announce: Callable[[str], None]
) -> tuple[list[str], list[Finding]]:
    projector = devices.projector
    questions: dict[str, Callable[[], object]] = {
        "camera": lambda: (devices.camera.identity(), devices.camera.configure(settings.camera.exposure)),
        "display": lambda: devices.presenter.show(Colour(0, 0, 0)),
    }
    if projector is not None:
        questions["projector"] = lambda: (projector.identity(), projector.power(), _require_no_fault(projector))
    ask_all(questions)
    body = devices.camera.identity()
    lines = [f"camera      {body.name}, serial {body.serial}"]
    warnings = devices.presenter.warnings() if isinstance(devices.presenter, ReportsWarnings) else ()
    findings = [Finding("screen", "remark", warning) for warning in warnings]
    if projector is None:
        lines.append("projector   not controlled: switch its lamp on and off by hand")
        return lines, findings
    state, _ = projector_state(projector)
    retry_policy = RetryPolicy(
        devices.clock, 0, lambda event, sentence: announce(f"{event}: {sentence}"), lambda: keep_awake(devices.camera)
    )
    make_ready(projector, settings.sequence, retry_policy)
    lines.append(f"projector   {state}; it stays on after the check")
    worn_parts = ", ".join(fault.part for fault in projector.faults() if fault.severity is Severity.WARNING)
    if worn_parts:
        warning = f"the projector reports a warning about its {worn_parts}"
        findings.append(Finding("projector", "remark", warning, remedy="read its display before the session"))
    return lines, findings


def _require_no_fault(projector: Projector) -> None:
    if (fault := reported_error(projector)) is not None:
        raise fault
