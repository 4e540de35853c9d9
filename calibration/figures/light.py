"""Figures of the lights: of one lamp, alone, in proportion to counts, and what their codes say."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from calibration.causes.gathering import (
    Gathered,
    brightness_evidence,
    dark_evidence,
    drift_evidence,
    light_evidence,
    name_evidence,
    stray_evidence,
    sum_evidence,
)
from calibration.checks.stray_light import CERTAIN
from calibration.figures.figure import (
    JUDGEMENT,
    SIMULATED,
    Explanation,
    Figure,
    Line,
    SummaryRow,
    format_value,
)
from calibration.radiometry.superposition import NODES
from foundation.colorimetry import angles_deg
from foundation.errors import first_few

if TYPE_CHECKING:
    import numpy.typing as npt

    from calibration.checks.light_codes import CodeAgreement
    from calibration.measurements import FrameMeasurements, TableMeasurements
    from experiment.session.records import FrameRecord

_PAIRS = 4  # Pairs of exchanged lights that a remark names; the report has all

_WARM_UP = "let the lamp warm up for longer before the session"


def percent(value: float) -> str:
    """Return a share, 0 … 1, for the summary."""
    return f"{100 * value:.2f} %"


def percents(values: npt.NDArray[np.floating]) -> str:
    """Return shares of R, G and B, (3,) float64, for the summary."""
    return " / ".join(f"{100 * value:.2f}" for value in values.tolist()) + " %"


def _are_alike(table: TableMeasurements) -> bool:
    """Return whether no names are exchanged and files tell of one camera and exposure, so that frames may be added."""
    exchanged = table.lights.codes is not None and len(table.lights.codes.exchanges) > 0
    return not exchanged and not table.origins.other_camera and not table.origins.other_exposure


def _are_named_right(table: TableMeasurements) -> bool:
    """Return whether white and the primaries are what they are called, so that they may be added up."""
    off, white = table.lights.off_codes_deg, table.lights.white_frames
    named = (off is None or not (off > 0).any()) and (white is None or not (white.off_deg > 0).any())
    return named and _are_alike(table)


def _has_drift(table: TableMeasurements) -> bool:
    return len({frame.record.sha256 for frame in table.white_frames}) > 1


def _repeated(table: TableMeasurements) -> float:
    files = [frame.record.sha256 for frame in table.frames]
    return float(len(files) - len(set(files)))


def _repeated_files(table: TableMeasurements, accepted: float) -> str:
    seen: dict[str, str] = {}
    again = [
        f"{frame.record.file} is {seen[frame.record.sha256]}"
        for frame in table.frames
        if seen.setdefault(frame.record.sha256, frame.record.file) != frame.record.file
    ]
    return first_few(again)


REPEATED_FILES = Figure(
    "repeated_files", "Frames whose file is that of another frame", "light", "", "at most", 0.0, None,
    why="one photograph stands for several: what changed between them, as the lamp's drift, was not seen",
    source="no two exposures have the same bytes", remedy="correct the list of frames that was imported",
    measure=_repeated, of_one_frame="bounded", where=_repeated_files,
)  # fmt: skip


def _white_drift(table: TableMeasurements) -> float | None:
    return table.white_drift if _has_drift(table) and table.lights.drift is None else None


def _drift_row(table: TableMeasurements) -> SummaryRow | None:
    if not _has_drift(table):
        return None
    return SummaryRow("Drift of white", percent(table.white_drift), "between white frames; 1 % is usual", brief=True)


WHITE_DRIFT = Figure(
    "white_drift", "Drift of paper white between white frames", "light", "share", "at most", 0.01, 0.15,
    why="lights taken at other times differ in brightness; each has its own ground truth, so its colour is right",
    source=JUDGEMENT + "; 1 % between whites is usual for a warm lamp", remedy=_WARM_UP,
    measure=_white_drift, cause=Explanation("drift", drift_evidence), drawing="course",
    lines=(Line(130, _drift_row),),
)  # fmt: skip


def _drift_left(table: TableMeasurements) -> float | None:
    drift = table.lights.drift
    return drift.left if drift is not None and len(table.white_frames) > 1 else None


DRIFT_LEFT = Figure(
    "drift_left", "Drift that white frames leave open, where it is taken out", "light", "share", "at most", 0.002,
    0.005,
    why="between two white frames the lamp jumps or flickers, and a light there is given another brightness than it "
    "had; its own ground truth goes along, so its colour is right",
    source=SIMULATED + ": 0.1 % of a steady drift on a small chart; a jump of 1 % leaves 0.5 %",
    remedy="build the table without --correct-drift, let the lamp warm up, or take white frames more often "
    "(sequence.reference_every)",
    before_session=False, measure=_drift_left, drawing="course",
)  # fmt: skip


def _white_drift_deg(table: TableMeasurements) -> float | None:
    white = np.array([frame.paper.white for frame in table.white_frames])
    return float(angles_deg(white, np.broadcast_to(white[0], white.shape)).max()) if _has_drift(table) else None


WHITE_DRIFT_DEG = Figure(
    "white_drift_deg", "Drift of white's colour", "light", "°", "at most", 0.2, 2.0,
    why="the lamp's spectrum changes, not its brightness alone",
    source=JUDGEMENT + ": a tenth of a good method's error", remedy=_WARM_UP,
    measure=_white_drift_deg, cause=Explanation("drift", drift_evidence), drawing="course",
)  # fmt: skip


def _shows_white(table: TableMeasurements) -> bool:
    """Return whether white is among what was read: a check may have read the frame of a light, of any colour."""
    return bool(table.white_frames) or not table.is_of_one_frame


def _leak(table: TableMeasurements) -> float | None:
    share = table.dark_share
    measured = np.isfinite(share) and table.lights.subtracted is None
    return share if measured and _shows_white(table) else None


def _dark_row(table: TableMeasurements) -> SummaryRow | None:
    dark, white = table.dark_frames, [frame.paper.white for frame in table.white_frames]
    if not dark.files or not white:
        return None
    counts = " / ".join(f"{value:.2f}" for value in dark.light.tolist())
    done = "not subtracted" if table.lights.subtracted is None else "subtracted from samples and ground truth"
    value = f"{counts} counts, {percents(dark.light / np.mean(white, axis=0))} of white"
    note = f"R, G, B of leak and ambient light on bare paper, {len(dark.files)} dark frames; {done}"
    return SummaryRow("Light while the projector shows black", value, note)


LEAK_SHARE = Figure(
    "leak_share", "Light while the projector shows black, relative to white", "light", "share", "at most", 0.005, 0.1,
    why="every light contains this much of the projector's leak and the room's light, so that deep colours are paler",
    source=JUDGEMENT + "; a contrast of 1 : 1500 leaks 0.07 %",
    remedy="darken the room, cover lamps and displays, or have it subtracted (build-lut --subtract-dark)",
    measure=_leak,
    of_one_frame="known", cause=Explanation("dark", dark_evidence), lines=(Line(210, _dark_row),),
)  # fmt: skip

DARK_DRIFT = Figure(
    "dark_drift", "Change of that light between dark frames, relative to white", "light", "share", "at most", 0.002,
    0.05,
    why="the room's light changes; what is subtracted, or part of each light, is not what was there",
    source=JUDGEMENT + ": a hundredth of a cell of a fifth of white",
    remedy="darken the room, and keep daylight out",
    measure=lambda table: table.dark_change if len(table.dark_frames.lights) > 1 else None, of_one_frame="bounded",
    cause=Explanation("dark", dark_evidence),
)  # fmt: skip


def _stray(table: TableMeasurements) -> float | None:
    return table.lights.stray.share if table.lights.stray is not None and _are_alike(table) else None


def _stray_row(table: TableMeasurements) -> SummaryRow | None:
    """Return what light single frames have beyond the dark ones, and how many lights could be asked."""
    name, stray = "Light that no dark frame shows", table.lights.stray
    if table.lights.codes is None:
        return None
    if stray is None:
        return SummaryRow(name, "not measured", "red, green and blue alone and a dark frame show it")
    note = (
        f"beyond {CERTAIN:g} standard errors; {int(stray.checked.sum())} of {len(stray.certain)} lights are checked by "
        "a code of 0, the primaries against white; of the others it is not known"
    )
    return SummaryRow(name, f"{percent(stray.share)} of white", note)


STRAY_SHARE = Figure(
    "stray_share", "Light in some frames that no dark frame shows, of white", "light", "share", "at most", 0.004, 0.01,
    why="a light contains it, or a primary that others are made of, so that deep colours are paler under some lights "
    "than under others; subtracting dark frames does not help",
    source=SIMULATED + ": below 0.1 % in healthy rooms; 1 % of white makes the darkest cells 10 % brighter, and puts "
    "deep lights 1 to 2 degrees off, which is a good method's error",
    remedy="darken the room, see that no door, lamp or display changes during the session, switch power saving and "
    "dynamic contrast off, and take the frames again",
    measure=_stray, cause=Explanation("stray", stray_evidence), lines=(Line(250, _stray_row),),
)  # fmt: skip


def _bend(table: TableMeasurements) -> float | None:
    """Return by how much superposition bends beyond two standard errors, over the levels of paper under the lights."""
    found = table.sensor.superposition
    if not found.measured or not _are_named_right(table):
        return None
    white = table.lights.white
    level = np.geomspace(max(float(white.min()), found.full * NODES[1]), float(white.max()), 30)
    errors = found.errors(level, np.full(len(level), level[-1]))
    off, _ = found.relative(level)
    bend = np.abs(off - off[-1])
    return float(np.maximum(bend - 2 * np.sqrt(np.maximum(errors - bend**2, 0)), 0).max())


def _linearity(table: TableMeasurements) -> float | None:
    return _bend(table) if table.sensor.linearity is None else table.sensor.linearity.worst


def _linearity_row(table: TableMeasurements) -> SummaryRow:
    linearity, bend = table.sensor.linearity, _bend(table)
    if linearity is not None:
        low, high = linearity.range
        note = f"{len(linearity.files)} exposures, {low:.0%} to {high:.0%} of saturation; 1 % is usual"
        return SummaryRow("Linearity", f"{percent(linearity.worst)} from a straight line at most", note)
    if bend is None:
        unmeasured = table.sensor.superposition.unmeasured
        note = "lights bear wrong names" if unmeasured is None else f"{unmeasured.why}; {unmeasured.remedy}"
        return SummaryRow("Linearity", "not measured", note)
    note = "for certain, over the levels of paper; red, green and blue alone against white, cell by cell"
    return SummaryRow("Linearity", f"{percent(bend)} from proportion", note)


LINEARITY = Figure(
    "linearity", "Deviation from linearity", "radiometry", "share", "at most", 0.01, 0.05,
    why="counts are not proportional to light, so that chromaticities change with brightness",
    source="EMVA 1288; 1 % is " + JUDGEMENT,
    remedy="expose less, switch the camera's highlight priority and noise reduction off; a series of exposures of the "
    "chart, given with --linearity, shows where counts bend",
    measure=_linearity, of_one_frame="known", lines=(Line(185, _linearity_row),),
)  # fmt: skip


def _linearity_known(table: TableMeasurements) -> float:
    return float(table.sensor.linearity is not None or table.sensor.superposition.measured)


def _linearity_lacks(table: TableMeasurements) -> tuple[str, str] | None:
    unmeasured = table.sensor.superposition.unmeasured
    return None if unmeasured is None else (f" ({unmeasured.why})", unmeasured.remedy)


LINEARITY_KNOWN = Figure(
    "linearity_known", "Linearity measured", "radiometry", "", "at least", 1.0, None,
    why="nothing shows whether counts are proportional to light; the uncertainty of the ground truth assumes what is "
    "usual of cameras",
    source="uncertainty budget",
    remedy="plan red, green and blue each alone (acquire illuminations does) for a chart of 512 colours or more, or "
    "give a series of exposures of the chart with --linearity",
    found=_linearity_lacks, before_session=False, measure=_linearity_known,
)  # fmt: skip


def _too_dark(table: TableMeasurements) -> float | None:
    """Return how much too much dark light was subtracted for certain, of white, in the worst channel.

    White has twice as much beyond the primaries' sum, in each channel as much as the dark frames' light allows; a
    projector that adds light to white adds more, and of another colour.
    """
    lights, dark = table.lights, table.dark_frames.light
    if lights.subtracted is None or lights.additivity is None or not _are_named_right(table):
        return None
    beyond, doubt = -lights.additivity.off / 2, table.white_scatter
    if table.sensor.superposition.measured:
        doubt = np.hypot(doubt, lights.additivity.error / 2)
    certain = beyond - 2 * doubt
    allowed = _DARK_ALLOWS * np.maximum(dark, 0) / lights.brightest + doubt
    return float(certain.max()) if (beyond > 0).all() and (beyond <= allowed).all() and (certain > 0).any() else 0.0


_DARK_ALLOWS = 1.25  # Over the dark frames' light, what may have been subtracted too much: all of it, and its error


TOO_DARK = Figure(
    "too_dark", "Dark light subtracted that lights do not have, of white", "light", "share", "at most", 0.0005, 0.002,
    why="white has more than red, green and blue together, each of which lacks what was subtracted too much; deep "
    "colours and dim lights are off by far more",
    source="0.2 % of white puts a light of a tenth of white 1 degree off",
    remedy="build the table without --subtract-dark; a lamp or a display was on while the dark frames were taken, or "
    "the projector closes an iris for black: take the dark frames as the lights are taken",
    before_session=False, measure=_too_dark,
)  # fmt: skip


def _beyond_sum(sign: int) -> Callable[[TableMeasurements], float | None]:
    """Return what measures by how much white is above (−1) or below (1) the sum of the primaries, a share."""

    def measure(table: TableMeasurements) -> float | None:
        off = table.lights.additivity
        # What was subtracted too much is a figure of its own.
        if off is None or not _are_named_right(table) or (sign < 0 and (_too_dark(table) or 0) > TOO_DARK.accept):
            return None
        return max(float((sign * off.off).max()), 0.0)

    return measure


def _sum_evidence(table: TableMeasurements, limit: float) -> Gathered:
    light = sum_evidence(table, limit)
    return light if light.frames else name_evidence(table, OFF_CODES_DEG.accept)


def _sum_row(table: TableMeasurements) -> SummaryRow | None:
    off = table.lights.additivity
    note = "R, G, B, of white; 0 is additive"
    return None if off is None else SummaryRow("Red + green + blue − white", percents(off.off), note)


ADDITIVITY = Figure(
    "additivity", "White against the sum of the primaries", "light", "share", "at most", 0.02, None,
    why="a light cannot be predicted from its codes: the projector brightens or converts white, or frames are not what "
    "they are called, or exposed otherwise",
    source=JUDGEMENT + "; the drift of the lamp is taken out first",
    remedy="switch off brilliant colour, white boost and dynamic contrast in the projector's menu",
    measure=_beyond_sum(-1), cause=Explanation("sum", _sum_evidence),
    lines=(Line(260, _sum_row),),
)  # fmt: skip

WHITE_DEFICIT = Figure(
    "white_deficit", "White short of the sum of the primaries", "light", "share", "at most", 0.05, 0.3,
    why="no wheel takes light away: a frame of white or of a primary was exposed otherwise, or the projector holds "
    "full white back",
    source=JUDGEMENT + "; a lamp that flickers by 1 % gives 2 %",
    remedy="look at the exposures of these frames, and switch dynamic contrast and power saving off",
    measure=_beyond_sum(1), cause=Explanation("brightness", light_evidence),
)  # fmt: skip


def _of_codes(value: Callable[[CodeAgreement], float]) -> Callable[[TableMeasurements], float | None]:
    """Return what measures how lights agree with their codes; None after a check."""
    return lambda table: None if table.lights.codes is None else value(table.lights.codes)


def _off_codes(table: TableMeasurements) -> float | None:
    off = table.lights.off_codes_deg
    return None if off is None else float(off.max())


def _light_name(index: int, count: int) -> str:
    return f"light {index}" if index < count else f"white frame {index - count}"


def _exchanges(table: TableMeasurements, accepted: float) -> str:
    """Return which lights bear each other's names; "" where none do."""
    codes, count = table.lights.codes, table.session.lights
    if codes is None or not codes.exchanges:
        return ""
    pairs = [f"{_light_name(pair.one, count)} and {_light_name(pair.other, count)}" for pair in codes.exchanges]
    apart = f"{codes.exchanges[0].angle_deg:.2g}° apart"
    more = f" (and {len(pairs) - _PAIRS} pairs more)" if len(pairs) > _PAIRS else ""
    return f"exchanged names: {', '.join(pairs[:_PAIRS])}{more}, {apart} in the first pair"


def _off_lights(table: TableMeasurements, accepted: float) -> str:
    lights, exchanged = table.lights.lights_off_codes(accepted), _exchanges(table, accepted)
    return f"{len(lights)} lights: {first_few(lights)}{f'; {exchanged}' if exchanged else ''}"


def _frames_off_codes(table: TableMeasurements, limit: float) -> list[FrameRecord]:
    lights = set(table.lights.lights_off_codes(limit))
    return [frame.record for frame in table.frames if frame.record.illumination in lights]


def _codes_row(table: TableMeasurements) -> SummaryRow | None:
    off = table.lights.off_codes_deg
    if off is None:
        return None
    worst = int(np.argmax(off))
    note = "angle between a white and what all other lights predict from its codes, beyond four standard errors"
    return SummaryRow("Lights against their codes", f"{off[worst]:.2f}° at most, light {worst}", note)


OFF_CODES_DEG = Figure(
    "off_codes_deg", "White of a light against what its codes predict", "light", "°", "at most", 2.0, 8.0,
    why="a frame bears another light's name, or was taken before the picture changed: codes in the table are not those "
    "of its whites",
    source=SIMULATED + ": 0 in random healthy rooms; a list of frames shifted by a row gives 28 and more, an exchange "
    "of two lights the angle between them",
    remedy="correct the list of frames that was imported, let the picture settle for longer (sequence.settle_s), or "
    "expose whole turns of the colour wheel",
    foremost=True, measure=_off_codes, where=_off_lights, retake=_frames_off_codes,
    cause=Explanation("names", name_evidence), drawing="lights", lines=(Line(220, _codes_row),),
)  # fmt: skip


def _brightness_text(table: TableMeasurements, accepted: float) -> str:
    """Return which lights are brighter or darker than their codes predict, the furthest off first."""
    codes = table.lights.codes
    if codes is None:
        return ""
    order = sorted(range(len(codes.off_brightness)), key=lambda light: -codes.off_brightness[light])
    found = [f"light {k} by {100 * codes.brightness[k]:+.0f} %" for k in order if codes.off_brightness[k] > accepted]
    return first_few(found)


def _frames_off_brightness(table: TableMeasurements, limit: float) -> list[FrameRecord] | None:
    if table.lights.codes is None:
        return None
    off = table.lights.codes.off_brightness

    def light_of(frame: FrameMeasurements) -> int:
        return sys.maxsize if frame.record.illumination is None else frame.record.illumination

    return [frame.record for frame in table.frames if light_of(frame) < len(off) and off[light_of(frame)] > limit]


OFF_BRIGHTNESS = Figure(
    "off_brightness", "Brightness of a light against what its codes predict", "light", "share", "at most", 0.1, 0.3,
    why="a frame was exposed otherwise than its file states, or another light; brightness differs between lights that "
    "should be alike",
    source=JUDGEMENT + ": lamps flicker by some per cent, the next shutter time is 26 % off",
    remedy="keep one exposure for the session, and take the frames again",
    measure=_of_codes(lambda codes: float(codes.off_brightness.max())), where=_brightness_text,
    retake=_frames_off_brightness,
    cause=Explanation("brightness", brightness_evidence, follows=("off_codes_deg", "exchanged_lights")),
)  # fmt: skip

EXCHANGED_LIGHTS = Figure(
    "exchanged_lights", "Pairs of lights that bear each other's names", "light", "", "at most", 0, None,
    why="their whites fit their codes when exchanged and not as they are; each ground truth is measured and right, "
    "but its codes and temperature are the other's",
    source=SIMULATED + ": none in random healthy rooms, all pairs further apart than the figure below in the others",
    remedy="correct the list of frames that was imported, or take both again",
    measure=_of_codes(lambda codes: float(len(codes.exchanges))), where=_exchanges,
    cause=Explanation("names", name_evidence), drawing="lights",
)  # fmt: skip

CODE_MISFIT = Figure(
    "code_misfit", "Disagreement of few lights with their codes, all together", "light", "", "at most", 1.0, None,
    why="no projector makes these whites of these codes, whichever light it is that is wrong",
    source=SIMULATED + ": 1 is what random healthy rooms stay below; of more than 24 lights each is judged by itself",
    remedy="look whether frames and lights belong together, and whether the lamp was steady",
    before_session=False, measure=_of_codes(lambda codes: codes.misfit), drawing="lights",
)  # fmt: skip

EXCHANGE_DEG = Figure(
    "exchange_deg", "Angle down to which exchanged names are excluded", "light", "°", "at most", 8.0, None,
    why="two lights less far apart than this could bear each other's names unnoticed",
    source=SIMULATED + ": 0.3 with 707 lights, 0 with eight that lie far apart",
    remedy="take white and the primaries along with the lights, and expose longer",
    before_session=False, measure=_of_codes(lambda codes: codes.exchange_deg), drawing="lights",
)  # fmt: skip


def _checked_text(table: TableMeasurements, accepted: float) -> str:
    codes = table.lights.codes
    return "" if codes is None else f"{int(codes.held.sum())} of {len(codes.held)}"


def _checked_row(table: TableMeasurements) -> SummaryRow | None:
    codes = table.lights.codes
    if codes is None:
        return None
    value = f"{_checked_text(table, 0.0)}; exchanged names excluded down to {format_value(codes.exchange_deg, '°')}"
    note = "the others are too few, or too dim, for a wrong name to be noticed"
    return SummaryRow("Lights held against their codes", value, note)


CROSS_CHECKED_SHARE = Figure(
    "cross_checked_share", "Lights that could be held against their codes", "light", "share", "at least", 0.9, None,
    why="of the others nothing says that they bear their own names",
    source="the angle from which a wrong name is refused, beyond what codes predict of so few lights",
    remedy="take white, red, green and blue along with the lights, and expose longer",
    before_session=False,
    measure=_of_codes(lambda codes: float(codes.held.mean())), where=_checked_text, lines=(Line(230, _checked_row),),
)  # fmt: skip

_WhiteValues = Callable[["CodeAgreement"], "npt.NDArray[np.float64]"]


def _white_frames(of: _WhiteValues) -> Callable[[TableMeasurements], float | None]:
    """Return what measures how far white frames are from what the lights predict; None without them."""

    def measure(table: TableMeasurements) -> float | None:
        return None if table.lights.white_frames is None else float(of(table.lights.white_frames).max())

    return measure


def _white_frames_beyond(of: _WhiteValues) -> Callable[[TableMeasurements, float], list[FrameRecord]]:
    """Return what tells the white frames that are further than a limit from what the lights predict."""

    def beyond(table: TableMeasurements, limit: float) -> list[FrameRecord]:
        white = table.lights.white_frames
        off: list[float] = [] if white is None else of(white).tolist()
        return [frame.record for frame, value in zip(table.white_frames, off, strict=False) if value > limit]

    return beyond


_beyond_deg = _white_frames_beyond(lambda white: white.off_deg)
_beyond_brightness = _white_frames_beyond(lambda white: white.off_brightness)

WHITE_FRAME_DEG = Figure(
    "white_frame_deg", "White frame against what the lights predict", "light", "°", "at most", 2.0, 8.0,
    why="the frame shows another light than white, or the lights bear wrong names",
    source=SIMULATED + ": 0 in random healthy rooms",
    remedy="correct the list of frames that was imported, or take the white frame again",
    foremost=True, measure=_white_frames(lambda white: white.off_deg),
    where=lambda table, accepted: first_few([one.file for one in _beyond_deg(table, accepted)]), retake=_beyond_deg,
    cause=Explanation("names", name_evidence), drawing="course",
)  # fmt: skip

WHITE_FRAME_BRIGHTNESS = Figure(
    "white_frame_brightness", "Brightness of the white frame against what the lights predict", "light", "share",
    "at most", 0.1, 0.3,
    why="the white frame was exposed otherwise than the lights, so that drift and stray light are read wrongly",
    source=JUDGEMENT + ": lamps flicker by some per cent, the next shutter time is 26 % off",
    remedy="keep one exposure for the session, and take the white frame again",
    measure=_white_frames(lambda white: white.off_brightness),
    where=lambda table, accepted: first_few([one.file for one in _beyond_brightness(table, accepted)]),
    retake=_beyond_brightness, cause=Explanation("brightness", light_evidence), drawing="course",
)  # fmt: skip


def _primaries_lacking(table: TableMeasurements) -> float | None:
    if table.lights.codes is None:
        return None
    alone = {light.index(max(light)) for light in table.session.codes if max(light) == sum(light) > 0}
    return float(3 - len(alone)) if alone else 0.0


def _fields_row(table: TableMeasurements) -> SummaryRow | None:
    if table.primaries is not None or table.lights.codes is None:
        return None
    note = "no frames of red, green and blue, each alone and bright enough; coloured cells are evened by paper's"
    return SummaryRow("Fields of the primaries", "not measured", note)


PRIMARIES_LACKING = Figure(
    "primaries_lacking", "Primaries without a frame of their own", "light", "", "at most", 0, None,
    why="the fields of the primaries were not measured, so that coloured cells are evened by the field of paper",
    source="where the primaries' fields differ by 10 %, coloured cells at corners are off by some tenths of a per cent",
    remedy="take red, green and blue, each alone, along with the lights",
    before_session=False, measure=_primaries_lacking, drawing="field", lines=(Line(240, _fields_row),),
)  # fmt: skip


def _tint(table: TableMeasurements) -> float | None:
    tint = table.greys.tints_deg(table.lights.white)
    return float(np.nanmax(tint)) if tint.size and np.isfinite(tint).any() and _shows_white(table) else None


def _tint_row(table: TableMeasurements) -> SummaryRow | None:
    if not table.greys.names:
        return None
    tints = zip(table.greys.names, table.greys.tints_deg(table.lights.white).tolist(), strict=True)
    note = (
        "angle to bare paper's camera RGB; a print through the printer's profile has 1° to 2.5°, for it is "
        "neutral to the eye and not to the camera, one of plain ink codes 4° to 8°"
    )
    return SummaryRow("Tint of the greys", ", ".join(f"{name}: {angle:.2f}°" for name, angle in tints), note)


GREY_TINT_DEG = Figure(
    "grey_tint_deg", "Tint of the print's greys against paper", "radiometry", "°", "at most", 6.0, None,
    why="greys are not neutral; the ground truth is paper's, so methods that rely on grey are judged by another grey "
    "on images by codes",
    source=JUDGEMENT + "; simulated prints have 1 to 2.5 through the printer's profile, 4.5 (poster paper) to 8 "
    "(glossy) where codes are ink codes, as the publication printed them",
    remedy="generate by colour, as it does unless told otherwise, which takes the print as it is measured; or have the "
    "chart printed through the printer's profile (docs/printing.md)",
    measure=_tint, of_one_frame="known", lines=(Line(270, _tint_row),),
)  # fmt: skip
