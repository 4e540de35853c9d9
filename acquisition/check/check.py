"""Check a rig before the session: devices asked, an exposure suggested, trial frames judged as a table is.

Takes some 25 frames into a hidden folder beside LAB.toml, which is removed at the end; records nothing. The lamp is
switched on if it was off, and stays on, which is said; a muted picture is shown.
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
    best_of,
    fitting_times,
    judge_exposure,
    level_of,
    measure_saturation,
    search,
)
from acquisition.check.findings import CheckReport, Finding, judged, not_checked
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
from acquisition.run.plan import bytes_text, free_bytes_at, planned_steps, projector_state, settings_doubts
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
from experiment.lights import load_illuminations
from experiment.measures.exposure import measure_exposure
from experiment.measures.paper import falloff
from experiment.measures.pose import keystone, off_level_deg
from experiment.session.folder import Session
from foundation.errors import RegistrationError, StorageError, counted
from foundation.files import write_atomic

# White at the settings' shutter time, of saturation, at which trial frames are taken so; else with a better time.
USABLE = (0.3, 0.9)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FoundExposure:
    """What white frames show of the exposure.

    - `first`: white at the shutter time of the settings.
    - `trials`, `times_s`: shutter times tried, that of the settings first, and those that can be used.
    """

    first: Shot
    trials: tuple[TriedTime, ...]
    times_s: tuple[float, ...]
    saturation: Saturation

    @property
    def used_s(self) -> float:
        """Shutter time of the trial frames."""
        first = self.trials[0]
        usable = USABLE[0] <= first.highest <= USABLE[1] and not first.clipped
        return first.shutter_s if usable else best_of(self.trials).shutter_s


def check_lab(
    settings: LabSettings,
    announce: Callable[[str], None] = lambda sentence: None,
    *,
    picture: Path | None = None,
    corners: Corners | None = None,
    linearity: bool = False,
) -> CheckReport:
    """Check the rig that the settings name; record nothing.

    `picture`: where to draw what was found, PNG. `corners`: of the field of a chart without tags, as given by hand,
    half-size px. `linearity`: whether to take a series of exposures that shows the sensor's linearity.
    """
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    frames = len(planned_steps(settings, lights))
    lines = [f"lights      {len(lights)} in {settings.illuminations.name}, {counted(frames, 'frame')} of a session"]
    beside = Path(settings.file).parent
    free_bytes_at(beside)
    # Not in /tmp, which may be in memory: the frames are 0.4 to 0.7 GB.
    with tempfile.TemporaryDirectory(prefix=".check.", dir=beside) as name:
        scratch = Path(name)
        with open_rig(settings, chart) as devices:
            described, screen = _make_devices_ready(devices, settings, announce)
            camera = Photographer(devices, settings, scratch)
            found = _find_exposure(camera, settings, chart, devices.camera.shutter_speeds(), announce)
            announce("taking trial frames: white, dark, primaries, grey")
            series = scratch / "series" if linearity else None
            best = best_of(found.trials)
            series_s = series_times(found.times_s, best.shutter_s, best.highest) if series else ()
            shots = [camera.take(colour, found.used_s) for colour in PRIMARIES.values()]
            primaries = np.array([shot.brightest(99.0) for shot in shots])
            shown = trial_lights(lights, primaries)
            steps = trial_steps(shown)
            _require_space(beside, (len(steps) + len(series_s)) * found.first.size)
            taken = Session.create(scratch / "trial", settings.to_toml(), chart, shown, steps)
            (scratch / "series").mkdir()
            take_trial(camera, taken, found.used_s, series_s, scratch / "series")
            camera.restore()
            supplies = judge_supplies(devices.camera, frames, found.first.size)
        announce("measuring the trial frames")
        with taken:
            trial = measure_trial(taken, found.saturation, corners, series)
    lines += described
    if found.used_s != found.first.shutter_s:
        lines.append(
            f"frames      taken at {found.used_s:.4g} s, since white is clipped or dark as the settings have it"
        )
    findings = [
        *_exposure_findings(found, settings),
        *_figure_findings(trial, settings),
        *_pose_and_light(trial, chart),
        judge_noise_reduction(camera.timings),
        *([not_checked("series", trial.series_trouble)] if trial.series_trouble else []),
        *screen,
        *(Finding("settings", "remark", doubt) for doubt in settings_doubts(settings)),
        judge_disk(beside, frames, found.first.size),
        *supplies,
    ]
    values = {row.figure.name: row.value for row in trial.verdict.rows}
    first_s = found.used_s if found.used_s != found.first.shutter_s else None
    outcome = None if trial.table is None or first_s is not None else trial.verdict.outcome
    report = CheckReport(tuple(lines), tuple(findings), outcome, values, trial.not_known, first_s)
    if picture is not None:
        write_atomic(picture, check_png(trial, chart, report))
    return report


def _require_space(folder: Path, needed: int) -> None:
    if (free := free_bytes_at(folder)) < needed:
        raise StorageError(
            f"{bytes_text(free)} free at {folder}, {bytes_text(needed, up=True)} needed for the frames of a check; "
            "free as much"
        )


def _find_exposure(
    camera: Photographer,
    settings: LabSettings,
    chart: Chart,
    offered_s: Sequence[float],
    announce: Callable[[str], None],
) -> FoundExposure:
    """Return how bright white is at the shutter times that were tried until one suits."""
    first = camera.take(WHITE)
    if settings.rig == "replay":
        stated, counts = float(first.mosaic.white_level), float(first.mosaic.saturation())
        saturation = Saturation(counts, counts < stated, stated)
        return FoundExposure(first, (level_of(first, saturation, _paper(first, chart)),), (), saturation)
    # A time that the body does not list was taken all the same, so it counts among them.
    times = fitting_times(sorted({*offered_s, settings.camera.shutter_s}) if offered_s else (), period_s(settings))
    announce("measuring the sensor's saturation: frames of white, longer and longer")
    saturation = measure_saturation(first, lambda seconds: camera.take(WHITE, seconds), times)

    def level(shot: Shot) -> TriedTime:
        return level_of(shot, saturation, _paper(shot, chart))

    trials = search(level(first), lambda seconds: level(camera.take(WHITE, seconds)), times)
    return FoundExposure(first, trials, tuple(times), saturation)


def _paper(shot: Shot, chart: Chart) -> _Array | None:
    """Return (3,) counts above black of bare paper, as the live judge measures it; None if the chart is not found."""
    if not chart.tags:
        return None
    black = frame_black(shot.mosaic)
    try:
        anchor = Anchor.of(shot.mosaic, black, chart)
    except RegistrationError:
        return None
    level = anchor.paper_level(shot.mosaic, black, phases(shot.mosaic))
    return None if np.isnan(level).any() else level


def _exposure_findings(found: FoundExposure, settings: LabSettings) -> list[Finding]:
    """Return the findings on the frame at the settings' exposure: its brightness, and what a run would refuse of it."""
    first = found.first.mosaic
    findings = [judge_exposure(found.trials, found.saturation, found.times_s, period_s(settings))]
    measured = measure_exposure(replace(first, white_level=round(found.saturation.counts)))
    refused = refusal(measured, "white", settings.limits)
    is_clipped = 100 * measured.clipped > settings.limits.clipped_percent
    said = f"{measured.clipped:.2%} of the photosites of a white frame are clipped"
    findings.append(Finding("clipping", "fault", refused or "") if is_clipped else Finding("clipping", "good", said))
    if refused is not None and not is_clipped:
        findings.append(Finding("exposure", "fault", refused))
    differs = disagreement(first, settings.camera.exposure)
    if differs is not None:
        findings.append(Finding("settings", "fault", differs, remedy="set the mode dial to M and touch no other"))
    return findings


def _figure_findings(trial: Trial, settings: LabSettings) -> list[Finding]:
    if trial.table is None:
        return [Finding("chart", "fault", trial.trouble), not_checked("figures", "the chart cannot be measured")]
    table = trial.table
    rows = [row for row in trial.verdict.rows if row.figure is not BRIGHTEST_SHARE]
    findings = [_figure_finding(row, table) for row in rows]
    value, allowed = trial.dark_percent, settings.judge.dark_percent
    if value <= allowed:
        return findings
    # The run refuses dark frames earlier than a table is refused.
    fault = Finding(
        LEAK_SHARE.name,
        "fault",
        f"the dark frame has {value:.1f} % of white, in the mean or in some places",
        value / 100,
        LEAK_SHARE.unit,
        tolerable=(None, allowed / 100),
        reason=f"judge.dark_percent allows {allowed:g} %: a run refuses the frame",
        remedy=LEAK_SHARE.remedy,
    )
    return [*(one for one in findings if one.name != LEAK_SHARE.name), fault]


def _figure_finding(row: JudgedValue, table: TableMeasurements) -> Finding:
    if row.outcome == "accept":
        return judged(row.figure, row.value)
    detail, remedy = detail_and_remedy(row.figure, table)
    cause = explain(row.figure, table)
    if cause is not None and cause.is_known:
        remedy = cause.decision.cause.remedy
        detail += f", probably {cause.decision.cause.description}"
    place = positions_text(cause)
    said = f"{row.figure.title}: {row.measured}{detail}{f', {place}' if place else ''}"
    return judged(row.figure, row.value, said, remedy)


def _pose_and_light(trial: Trial, chart: Chart) -> list[Finding]:
    if trial.table is None:
        return [not_checked(one.name, "the chart cannot be measured") for one in (TURN, KEYSTONE, EVENNESS)]
    table = trial.table
    framing, (width, height) = table.registration.framing, chart.page_mm
    off, quarters = off_level_deg(framing.rotation_deg)
    turned = f"; it is turned by {90 * quarters}° besides, which does no harm" if quarters else ""
    across, down = keystone(project(framing.homography, [(0, 0), (width, 0), (width, height), (0, height)]))
    lost = falloff(table.frames[0].paper.field.at(chart.centres_mm))
    return [
        judged(
            TURN, abs(off), f"the chart's rows are {off:+.1f}° to the picture's{turned}", details={"turned": quarters}
        ),
        judged(KEYSTONE, max(across, down), details={"across": across, "down": down}),
        judged(
            EVENNESS,
            float(lost.max()),
            f"lens and projector together lose {100 * lost.max():.0f} % of the light at the darkest place of the chart",
            details={"falloff": lost.tolist()},
        ),
    ]


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
    state, _ = projector_state(projector)
    patience = RetryPolicy(
        devices.clock, 0, lambda what, sentence: announce(f"{what}: {sentence}"), lambda: keep_awake(devices.camera)
    )
    make_ready(projector, settings.sequence, patience)
    lines.append(f"projector   {state}; it stays on when the check is over")
    parts = [fault.part for fault in projector.faults() if fault.severity is Severity.WARNING]
    if parts:
        said = f"the projector warns of its {', '.join(parts)}"
        findings.append(Finding("projector", "remark", said, remedy="look at its display before the session"))
    return lines, findings


def _require_sound(projector: Projector) -> None:
    if (fault := reported_error(projector)) is not None:
        raise fault
