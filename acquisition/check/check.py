"""Check a rig before the session: devices asked, frames taken and thrown away, verdicts, a forecast of the table.

Takes 10 to 20 frames; records nothing. The lamp is switched on if it was off, and stays on, which is said; a muted
picture is shown.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

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
from acquisition.check.findings import LIMITS, CheckReport, Finding, judged, not_checked, not_checked_all, percent
from acquisition.check.frames import (
    ChartMeasurements,
    CheckFrames,
    Photographer,
    PlacedChart,
    Shot,
    chart_levels,
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
    no_light,
)
from acquisition.check.places import Levels, smallest_cell_px
from acquisition.judge.measure import disagreement
from acquisition.run.devices import Devices, RetryPolicy, ask_all, make_ready, period_s, reported_error
from acquisition.run.plan import planned_steps, settings_doubts
from acquisition.run.rig.opening import open_rig
from calibration.figures.all_figures import BY_NAME, FIGURES
from calibration.figures.figure import CheckMeasurements, Figure, Outcome, worst_outcome
from calibration.figures.light import ADDITIVITY, GREY_TINT_DEG, LINEARITY
from calibration.figures.radiometry import UNFIT_SHARE
from calibration.figures.truth import DARKEST_COUNTS, REFERENCE_SPREAD, REFERENCES_USED
from drivers.camera import keep_awake
from drivers.presenter import Colour, ReportsWarnings
from drivers.projector import Power, Projector, Severity
from drivers.raw.rawfile import frame_black
from experiment.chart.model import Chart, load_chart
from experiment.config import LabSettings
from experiment.framing.field import Corners
from experiment.framing.sharpness import blur_px
from experiment.lights import Illumination, load_illuminations
from experiment.measures.paper import Paper, PaperReader
from experiment.measures.stains import Stains, find_stains
from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import DeviceError, QualityError, counted
from foundation.files import write_whole

LEAST_WHITE = 100.0
"""Counts of paper under white in the weakest channel, from which on lights are compared with it."""

_OF_PRIMARIES = ("brightest light", ADDITIVITY.name, "flicker", "brightness")
"""What is judged by frames of the primaries, and of white again."""

CLIPPED = "white is clipped at every shutter time that was tried"
"""Why nothing can be said of the light."""


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
    half-size px. `linearity`: whether to take a series of exposures that shows the sensor's linearity and noise.
    """
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    frames = len(planned_steps(settings, lights))
    lines = [f"lights      {len(lights)} in {settings.illuminations.name}, {counted(frames, 'frame')} of a session"]
    with open_rig(settings, chart) as devices, tempfile.TemporaryDirectory() as scratch:
        described, screen = _make_devices_ready(devices, settings, announce)
        lines += described
        camera = Photographer(devices, settings, Path(scratch))
        seen = look(
            camera, settings, chart, devices.camera.shutter_speeds(), period_s(settings), corners, linearity, announce,
        )  # fmt: skip
        supplies = judge_supplies(devices.camera, frames, seen.first.size)
    figures = None if seen.chart is None else measure_chart(seen, seen.chart, chart)
    recorded = settings.rig == "replay"
    findings = [
        *_exposure_findings(seen, settings, recorded),
        *_chart_findings(seen, figures, chart, picture),
        *_light_findings(seen, figures, chart, bool(lights), settings.judge.dark_percent),
        *_sensor_findings(seen, camera.timings, figures, chart, linearity),
        *screen,
        *(Finding("settings", "remark", doubt) for doubt in settings_doubts(settings)),
        judge_disk(Path(settings.file).parent, frames, seen.first.size),
        *supplies,
    ]
    if seen.used_s != seen.first.shutter_s:
        lines.append(f"frames      all but exposure and clipping judged at {seen.used_s:.4g} s")
    table = _forecast(seen, chart, lights)
    why_not = "the chart was not found" if seen.chart is None else "" if seen.usable else CLIPPED
    findings += forecast_findings(table, chart, why_not)
    outcome = None if seen.chart is None else table.outcome
    report = CheckReport(tuple(lines), tuple(findings), outcome, table.figures, table.not_known)
    if picture is not None:
        from acquisition.check.picture import check_png

        write_whole(picture, check_png(seen, figures, chart, report))
    return report


def _exposure_findings(seen: CheckFrames, settings: LabSettings, recorded: bool) -> list[Finding]:
    findings = [
        judge_exposure(seen.trials, seen.saturation, seen.times_s, period_s(settings), recorded),
        judge_clipping(
            seen.first.mosaic,
            seen.first.shutter_s,
            seen.saturation.counts,
            settings.limits.clipped_percent,
            seen.chart.place if seen.chart else None,
        ),
    ]
    differs = None if recorded else disagreement(seen.first.mosaic, settings.camera.exposure)
    if differs is not None:
        findings.append(Finding("settings", "fault", differs, remedy="set the mode dial to M and touch no other"))
    return findings


def _chart_findings(
    seen: CheckFrames, figures: ChartMeasurements | None, chart: Chart, picture: Path | None
) -> list[Finding]:
    if figures is None:
        look_at = "" if picture is None else f"see {picture}"
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
        judge_sharpness(figures.blur, chart, framing.module_px, smallest_cell_px(chart, place)),
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
    linearity: bool,
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
    if not linearity:
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
    patience = RetryPolicy(
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


_HELPS = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less, and keep reflections off the chart",
    "stained": "clean the print or print it anew, and light it evenly",
}
"""What helps against each cause of unfit cells."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Forecast:
    """What can be said of a table before its session.

    - `figures`: values by the names of figures, as in `report.json`.
    - `unfit`: share of the cells that would be unfit, by cause.
    """

    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    unfit: Mapping[str, float] = field(default_factory=dict[str, float])

    @staticmethod
    def of(check: CheckMeasurements) -> Forecast:
        """Return what the measurements of a check say."""
        values = ((one.name, one.forecast(check)) for one in FIGURES if one.forecast is not None)
        return Forecast({name: value for name, value in values if value is not None}, check.unfit)

    @property
    def outcomes(self) -> dict[str, Outcome]:
        """What each figure does to the table."""
        return {name: BY_NAME[name].outcome(value) for name, value in self.figures.items()}

    @property
    def outcome(self) -> Outcome:
        """The worst of them: the verdict as far as it is known."""
        return worst_outcome(self.outcomes.values())

    @property
    def not_known(self) -> tuple[str, ...]:
        """The names of the figures that are known only when there are frames of a session."""
        return tuple(figure.name for figure in FIGURES if figure.name not in self.figures)

    def value(self, figure: Figure) -> float | None:
        """Return a figure's value, where it is known."""
        return self.figures.get(figure.name)


def measure_table(
    chart: Chart, placed: PlacedChart, whites: tuple[Shot, ...], dark: Shot | None, saturation: float
) -> CheckMeasurements:
    """Return what white frames, and a dark one, show of a table.

    `whites`, `dark`: frames of one exposure; None where there is no dark one. `saturation`: raw count at which the
    sensor saturates.
    """
    framing = placed.framing
    cells, references = chart_levels(whites, placed, chart, saturation)
    white = np.array([reference.is_white for reference in chart.references], dtype=np.bool_)
    seen = np.where(references.clipped[:, None], np.nan, references.mean)
    paper = _paper(chart, seen[white])
    stains = None if paper is None else _stains(chart, cells, paper)
    unfit = _unfit_cells(cells, stains, chart)
    usable = int(np.isfinite(seen[white]).all(axis=1).sum())
    tint, leak, brightest = None, None, None
    if paper is not None:
        places = _places(chart)
        brightest = float(paper.white.max()) / (saturation - float(frame_black(whites[0].mosaic).mean()))
        tint = _tint_deg(chart, seen[~white] / paper.field.at(places[~white]), paper.white, white)
        if dark is not None:
            black = mean_levels((dark,), placed, places[white], saturation).mean / paper.field.at(places[white])
            leak = np.nanmedian(np.where(np.isfinite(black), black, np.nan), axis=0) / paper.white
    found = len(framing.tags)
    return CheckMeasurements(
        tags_found=None if framing.field is not None else found / max(found + len(framing.missing), 1),
        cell_px=smallest_cell_px(chart, placed.place),
        blur_px=blur_px(framing),
        unfit={cause: float(mask.mean()) for cause, mask in unfit.items()},
        unfit_share=float(np.any(list(unfit.values()), axis=0).mean()),
        stains=stains,
        references_used=usable / max(int(white.sum()), 1),
        paper=paper,
        tint_deg=tint,
        leak=leak,
        brightest_share=brightest,
    )


def darkest_counts(
    lights: Sequence[Illumination], primaries: Mapping[str, _Array], exposure_ratio: float = 1.0
) -> float | None:
    """Return the counts of paper under a plan's darkest light, as its primaries and sRGB's curve give it.

    `primaries`: (3,) counts above black of paper under "red", "green", "blue" and "black", at one exposure.
    """
    if not lights:
        return None
    shares = decode_srgb(np.array([light.colour for light in lights]) / 255)
    black = primaries["black"]
    alone = np.stack([primaries[name] - black for name in ("red", "green", "blue")])
    return float(((shares @ alone + black) * exposure_ratio).max(axis=1).min())


def _places(chart: Chart) -> _Array:
    return np.array([reference.centre_mm for reference in chart.references], dtype=np.float64).reshape(-1, 2)


def _paper(chart: Chart, seen: _Array) -> Paper | None:
    """Return what the white references show, (W, 3) counts; None where a table takes them from the cells, or cannot."""
    if not chart.tags:
        return None
    places = np.array([each.centre_mm for each in chart.white_references], dtype=np.float64).reshape(-1, 2)
    try:
        base = PaperReader(places, chart.centres_mm, chart.page_mm).read(seen)[0].field
        return PaperReader(places, chart.centres_mm, chart.page_mm, base).read(seen)[0]
    except QualityError:
        return None


def _stains(chart: Chart, cells: Levels, paper: Paper) -> Stains:
    """Return where cells are not of their codes' colours, in the order of colour indices."""
    order = chart.cell_of_colour
    points = chart.centres_mm[order]
    level = np.nan_to_num(cells.mean[order]) / paper.field.at(points)
    return find_stains(level, points, chart.bits, np.asarray(np.isfinite(cells.mean[order]).all(axis=1)))


def _unfit_cells(cells: Levels, stains: Stains | None, chart: Chart) -> dict[str, _Mask]:
    """Return the cells (C,) that a table would list as unfit, by the causes that one light shows."""
    outside: _Mask = np.asarray(~np.isfinite(cells.mean).all(axis=1))
    stained = np.zeros(len(outside), dtype=np.bool_)
    if stains is not None:
        stained[chart.cell_of_colour] = stains.stained
    return {"outside": outside, "clipped": cells.clipped & ~outside, "stained": stained & ~outside & ~cells.clipped}


def _tint_deg(chart: Chart, flat: _Array, white: _Array, is_white: _Mask) -> float | None:
    """Return the largest angle between a printed level of grey, (N, 3) field divided out, and paper white (3,)."""
    codes = np.array([each.rgb for each, paper in zip(chart.references, is_white, strict=True) if not paper])
    if not len(codes):
        return None
    found = [
        np.nanmedian(flat[(codes == code).all(axis=1)], axis=0)
        for code in np.unique(codes, axis=0)
        if np.isfinite(flat[(codes == code).all(axis=1)]).any()
    ]
    return float(angles_deg(np.array(found), white).max()) if found else None


def forecast_findings(table: Forecast, chart: Chart, why_not: str = "") -> list[Finding]:
    """Return the findings on the figures of a table that no other finding judges.

    `why_not`: why the frames show nothing; "" where they do.
    """
    return [_references(table, chart, why_not), _unfit(table, why_not), _tint(table, why_not), _darkest(table, why_not)]


def _references(table: Forecast, chart: Chart, why_not: str) -> Finding:
    spread, used = table.value(REFERENCE_SPREAD), table.value(REFERENCES_USED)
    if spread is None or used is None:
        return not_checked("references", why_not or no_light(chart))
    found = judged(
        LIMITS["references"],
        spread,
        f"white references lie {percent(spread)} RMS about the smooth light, {percent(used)} of them usable",
        "keep reflections and shadows off the print, clean or flatten it",
        {"used": used},
    )
    if found.grade == "good" and REFERENCES_USED.outcome(used) != "accept":
        remedy = "uncover the print, and bring all of it into the picture"
        return replace(found, grade="remark", reason=REFERENCES_USED.why, remedy=remedy)
    return found


def _unfit(table: Forecast, why_not: str) -> Finding:
    share = table.value(UNFIT_SHARE)
    if share is None:
        return not_checked("unfit cells", why_not or "stains cannot be judged, and no other cause is seen")
    causes = {cause: part for cause, part in table.unfit.items() if part > 0}
    described = ", ".join(f"{percent(part)} {cause}" for cause, part in causes.items())
    return judged(
        LIMITS["unfit cells"],
        share,
        f"{percent(share)} of the cells would be unfit for use{f': {described}' if described else ''}",
        "; ".join(_HELPS[cause] for cause in causes),
        dict(table.unfit),
    )


def _tint(table: Forecast, why_not: str) -> Finding:
    tint = table.value(GREY_TINT_DEG)
    if tint is None:
        return not_checked("grey tint", why_not or "the chart has no grey references in the field of its white ones")
    return judged(
        LIMITS["grey tint"],
        tint,
        f"printed greys are up to {tint:.1f}° off paper white, which images by codes have and those by colour have not",
        "generate by colour, as it does unless told otherwise, or have the chart printed through the printer's profile",
    )


def _darkest(table: Forecast, why_not: str) -> Finding:
    counts = table.value(DARKEST_COUNTS)
    if counts is None:
        return not_checked("darkest light", why_not or "a recording's primaries are not asked for")
    return judged(
        LIMITS["darkest light"],
        counts,
        f"bare paper will have about {counts:.0f} counts under the plan's darkest light",
        "expose longer, or leave the darkest lights out",
    )
