"""Figures of the illuminants: lamp drift, other light, additivity, codes, linearity, and tint of greys."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from calibration.causes.gathering import (
    CauseEvidence,
    brightness_evidence,
    dark_evidence,
    drift_evidence,
    light_evidence,
    name_evidence,
    stray_evidence,
    sum_evidence,
)
from calibration.checks.stray_light import CERTAIN_SIGMAS
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

_MAX_PAIRS = 4  # Largest number of exchanged pairs in a remark; the report lists all pairs

_WARM_UP = "let the lamp warm up for longer before the session"


def percent(value: float) -> str:
    """Return a fraction as text, in %."""
    return f"{100 * value:.2f} %"


def percents(values: npt.NDArray[np.floating]) -> str:
    """Return fractions of R, G and B, (3,) float64, as text, in %."""
    return " / ".join(f"{100 * value:.2f}" for value in values.tolist()) + " %"


def _are_frames_comparable(table: TableMeasurements) -> bool:
    # Sums of the counts of several frames are valid only if names, camera and exposure are correct.
    exchanged = table.lights.codes is not None and len(table.lights.codes.exchanges) > 0
    return not exchanged and not table.origins.other_camera and not table.origins.other_exposure


def _are_names_right(table: TableMeasurements) -> bool:
    off_codes_deg, white_frames = table.lights.off_codes_deg, table.lights.white_frames
    match_codes = off_codes_deg is None or not (off_codes_deg > 0).any()
    match_codes = match_codes and (white_frames is None or not (white_frames.off_deg > 0).any())
    return match_codes and _are_frames_comparable(table)


def _has_drift(table: TableMeasurements) -> bool:
    return len({frame.record.sha256 for frame in table.white_frames}) > 1


def _repeated_count(table: TableMeasurements) -> float:
    files = [frame.record.sha256 for frame in table.frames]
    return float(len(files) - len(set(files)))


def _repeated_files_text(table: TableMeasurements, accepted: float) -> str:
    file_by_hash: dict[str, str] = {}
    repetitions = [
        f"{frame.record.file} is {file_by_hash[frame.record.sha256]}"
        for frame in table.frames
        if file_by_hash.setdefault(frame.record.sha256, frame.record.file) != frame.record.file
    ]
    return first_few(repetitions)


REPEATED_FILES = Figure(
    "repeated_files", "Frames with the same file as another frame", "light", "", "at most", 0.0, None,
    why="one photograph is used for several frames: changes between them, such as drift of the lamp, are not measured",
    source="two exposures never have the same bytes", remedy="correct the list of imported frames",
    measure=_repeated_count, from_one_frame="beyond", where=_repeated_files_text,
)  # fmt: skip


def _white_drift(table: TableMeasurements) -> float | None:
    return table.white_drift if _has_drift(table) and table.lights.drift is None else None


def _drift_row(table: TableMeasurements) -> SummaryRow | None:
    if not _has_drift(table):
        return None
    return SummaryRow("Drift of white", percent(table.white_drift), "between white frames; 1 % is usual", brief=True)


WHITE_DRIFT = Figure(
    "white_drift", "Drift of paper white between white frames", "light", "share", "at most", 0.01, 0.15,
    why="illuminants taken at different times differ in brightness; the colour of each ground truth is correct",
    source=JUDGEMENT + ". A warm lamp usually drifts by 1 % between white frames", remedy=_WARM_UP,
    measure=_white_drift, cause=Explanation("drift", drift_evidence), drawing="frames", lines=(Line(130, _drift_row),),
)  # fmt: skip


def _drift_residual(table: TableMeasurements) -> float | None:
    drift = table.lights.drift
    return drift.uncertainty if drift is not None and len(table.white_frames) > 1 else None


DRIFT_LEFT = Figure(
    "drift_left", "Drift that may remain after --correct-drift", "light", "share", "at most", 0.002, 0.005,
    why="the lamp jumps or flickers between two white frames, so that an illuminant gets a wrong brightness; the "
    "colour of its ground truth is correct",
    source=SIMULATED + ": a steady drift has 0.1 %, a jump of 1 % has 0.5 %",
    remedy="build the LUT without --correct-drift, let the lamp warm up, or take white frames more often "
    "(sequence.reference_every)", before_session=False, measure=_drift_residual, drawing="frames",
)  # fmt: skip


def _white_drift_deg(table: TableMeasurements) -> float | None:
    white = np.array([frame.paper.white for frame in table.white_frames])
    return float(angles_deg(white, np.broadcast_to(white[0], white.shape)).max()) if _has_drift(table) else None


WHITE_DRIFT_DEG = Figure(
    "white_drift_deg", "Drift of the colour of paper white", "light", "°", "at most", 0.2, 2.0,
    why="the lamp's spectrum changes, and not only its brightness",
    source=JUDGEMENT + ": a tenth of the angular error of a good method", remedy=_WARM_UP,
    measure=_white_drift_deg, cause=Explanation("drift", drift_evidence), drawing="frames",
)  # fmt: skip


def _shows_white(table: TableMeasurements) -> bool:
    # The single frame of `build-lut check` may show a coloured illuminant.
    return bool(table.white_frames) or not table.is_of_one_frame


def _leak_share(table: TableMeasurements) -> float | None:
    share = table.dark_share
    is_unsubtracted = np.isfinite(share) and table.lights.subtracted is None
    return share if is_unsubtracted and _shows_white(table) else None


def _dark_row(table: TableMeasurements) -> SummaryRow | None:
    dark, white = table.dark_frames, [frame.paper.white for frame in table.white_frames]
    if not dark.files or not white:
        return None
    counts = " / ".join(f"{value:.2f}" for value in dark.light.tolist())
    treatment = "not subtracted" if table.lights.subtracted is None else "subtracted from samples and ground truth"
    value = f"{counts} counts, {percents(dark.light / np.mean(white, axis=0))} of white"
    note = f"R, G, B of projector leak and room light on bare paper, {len(dark.files)} dark frames; {treatment}"
    return SummaryRow("Light while the projector shows black", value, note)


LEAK_SHARE = Figure(
    "leak_share", "Light while the projector shows black, relative to white", "light", "share", "at most", 0.005, 0.1,
    why="every illuminant contains this light of projector and room, so that saturated colours become paler",
    source=JUDGEMENT + ". A projector with a contrast of 1500 : 1 has 0.07 %",
    remedy="darken the room, cover lamps and displays, or subtract this light (build-lut --subtract-dark)",
    measure=_leak_share, from_one_frame="yes", cause=Explanation("dark", dark_evidence), lines=(Line(210, _dark_row),),
)  # fmt: skip

DARK_DRIFT = Figure(
    "dark_drift", "Change of the light in dark frames, relative to white", "light", "share", "at most", 0.002,
    0.05,
    why="the light of the room changes; illuminants contain varying amounts of it, or a wrong amount is subtracted",
    source=JUDGEMENT + ": 0.2 % of white is 1 % of the light of a patch with a reflectance of 20 %",
    remedy="darken the room, and keep daylight out",
    measure=lambda table: table.dark_change if len(table.dark_frames.lights) > 1 else None, from_one_frame="beyond",
    cause=Explanation("dark", dark_evidence),
)  # fmt: skip


def _stray_share(table: TableMeasurements) -> float | None:
    return table.lights.stray.share if table.lights.stray is not None and _are_frames_comparable(table) else None


def _stray_row(table: TableMeasurements) -> SummaryRow | None:
    name, stray = "Light that is not in the dark frames", table.lights.stray
    if table.lights.codes is None:
        return None
    if stray is None:
        return SummaryRow(name, "not measured", "needs frames of red, green and blue alone, and a dark frame")
    note = (
        f"minus {CERTAIN_SIGMAS:g} standard errors, in {int(stray.checked.sum())} of {len(stray.certain)} illuminants "
        "(those with a code of 0) and in the primaries"
    )
    return SummaryRow(name, f"{percent(stray.share)} of white", note)


STRAY_SHARE = Figure(
    "stray_share", "Light in some frames that is not in the dark frames, relative to white", "light", "share",
    "at most", 0.004, 0.01,
    why="some illuminants contain this light, so that saturated colours are paler under them than under others; "
    "subtracting dark frames does not help",
    source=SIMULATED + ": below 0.1 % without faults. Light of 1 % changes a saturated illuminant by 1° to 2°",
    remedy="darken the room, keep doors, lamps and displays unchanged during the session, switch power saving and "
    "dynamic contrast off, and take the frames again",
    measure=_stray_share, cause=Explanation("stray", stray_evidence), lines=(Line(250, _stray_row),),
)  # fmt: skip


def _superposition_deviation(table: TableMeasurements) -> float | None:
    # Largest deviation minus two standard errors, over the range of counts of paper under the illuminants.
    superposition = table.sensor.superposition
    if not superposition.measured or not _are_names_right(table):
        return None
    white = table.lights.white
    level = np.geomspace(max(float(white.min()), superposition.full * NODES[1]), float(white.max()), 30)
    errors = superposition.errors(level, np.full(len(level), level[-1]))
    relative_error, _ = superposition.relative(level)
    deviation = np.abs(relative_error - relative_error[-1])
    return float(np.maximum(deviation - 2 * np.sqrt(np.maximum(errors - deviation**2, 0)), 0).max())


def _linearity_deviation(table: TableMeasurements) -> float | None:
    return _superposition_deviation(table) if table.sensor.linearity is None else table.sensor.linearity.worst


def _linearity_row(table: TableMeasurements) -> SummaryRow:
    linearity, deviation = table.sensor.linearity, _superposition_deviation(table)
    if linearity is not None:
        low, high = linearity.range
        note = f"{len(linearity.files)} exposures, {low:.0%} to {high:.0%} of saturation; 1 % is usual"
        return SummaryRow("Linearity", f"{percent(linearity.worst)} at most from a straight line", note)
    if deviation is None:
        unmeasured = table.sensor.superposition.unmeasured
        note = "illuminants have wrong names" if unmeasured is None else f"{unmeasured.why}; {unmeasured.remedy}"
        return SummaryRow("Linearity", "not measured", note)
    note = "minus two standard errors; from all patches under white, compared with red, green and blue alone"
    return SummaryRow("Linearity", f"{percent(deviation)} from proportionality", note)


LINEARITY = Figure(
    "linearity", "Deviation from linearity", "radiometry", "share", "at most", 0.01, 0.05,
    why="counts are not proportional to light, so that chromaticities change with brightness",
    source=JUDGEMENT + "; defined in EMVA 1288",
    remedy="expose less, and switch the camera's highlight priority and noise reduction off; a series of exposures "
    "of the chart, given with --linearity, shows the range of the deviation",
    measure=_linearity_deviation, from_one_frame="yes", lines=(Line(185, _linearity_row),),
)  # fmt: skip


def _is_linearity_measured(table: TableMeasurements) -> float:
    return float(table.sensor.linearity is not None or table.sensor.superposition.measured)


def _linearity_detail(table: TableMeasurements) -> tuple[str, str] | None:
    unmeasured = table.sensor.superposition.unmeasured
    return None if unmeasured is None else (f" ({unmeasured.why})", unmeasured.remedy)


LINEARITY_KNOWN = Figure(
    "linearity_known", "Linearity measured", "radiometry", "", "at least", 1.0, None,
    why="the proportionality of counts and light is unknown; the uncertainty of the ground truth assumes a typical "
    "camera", source="by definition",
    remedy="plan red, green and blue alone (acquire illuminations does) for a chart of at least 512 colours, or give "
    "a series of exposures of the chart with --linearity",
    detail=_linearity_detail, before_session=False, measure=_is_linearity_measured,
)  # fmt: skip


def _oversubtracted_share(table: TableMeasurements) -> float | None:
    # If too much dark light is subtracted, the sum of the primaries lacks it three times, and white once. White then
    # exceeds the sum in every channel. A projector that brightens white adds more light than the dark light.
    lights, dark = table.lights, table.dark_frames.light
    if lights.subtracted is None or lights.additivity is None or not _are_names_right(table):
        return None
    excess, uncertainty = -lights.additivity.off / 2, table.white_scatter
    if table.sensor.superposition.measured:
        uncertainty = np.hypot(uncertainty, lights.additivity.error / 2)
    certain = excess - 2 * uncertainty
    allowed = _DARK_MARGIN * np.maximum(dark, 0) / lights.brightest + uncertainty
    is_dark_light = (excess > 0).all() and (excess <= allowed).all() and (certain > 0).any()
    return float(certain.max()) if is_dark_light else 0.0


_DARK_MARGIN = 1.25  # Dark light explains an excess up to this multiple of it, because its measurement has an error


TOO_DARK = Figure(
    "too_dark", "Dark light subtracted in excess, relative to white", "light", "share", "at most", 0.0005, 0.002,
    why="too much light was subtracted from every illuminant, which changes the colours of saturated and dim ones most",
    source="calculated: 0.2 % of white changes an illuminant with 10 % of white by 1°",
    remedy="build the LUT without --subtract-dark, or take dark frames under the conditions of the other frames: with "
    "the same lamps and displays, and without the iris that some projectors close for black",
    before_session=False, measure=_oversubtracted_share,
)  # fmt: skip


def _sum_deviation(sign: int) -> Callable[[TableMeasurements], float | None]:
    def measure(table: TableMeasurements) -> float | None:
        white = table.lights.additivity
        # Light subtracted in excess is judged by TOO_DARK.
        is_oversubtracted = sign < 0 and (_oversubtracted_share(table) or 0) > TOO_DARK.accept
        if white is None or not _are_names_right(table) or is_oversubtracted:
            return None
        return max(float((sign * white.off).max()), 0.0)

    return measure


def _sum_evidence(table: TableMeasurements, limit: float) -> CauseEvidence:
    light = sum_evidence(table, limit)
    return light if light.frames else name_evidence(table, OFF_CODES_DEG.accept)


def _sum_row(table: TableMeasurements) -> SummaryRow | None:
    additivity = table.lights.additivity
    note = "R, G, B, relative to white; 0 if additive"
    return None if additivity is None else SummaryRow("Red + green + blue − white", percents(additivity.off), note)


ADDITIVITY = Figure(
    "additivity", "White above the sum of the primaries", "light", "share", "at most", 0.02, None,
    why="an illuminant cannot be predicted from its codes: the projector brightens or converts white, or frames have "
    "wrong names or exposures", source=JUDGEMENT + ". Drift of the lamp is corrected before the comparison",
    remedy="switch off brilliant colour, white boost and dynamic contrast in the projector's menu",
    measure=_sum_deviation(-1), cause=Explanation("sum", _sum_evidence), lines=(Line(260, _sum_row),),
)  # fmt: skip

WHITE_DEFICIT = Figure(
    "white_deficit", "White below the sum of the primaries", "light", "share", "at most", 0.05, 0.3,
    why="a frame of white or of a primary has another exposure, or the projector reduces full white",
    source=JUDGEMENT + ". A lamp that flickers by 1 % causes 2 %",
    remedy="check the exposures of these frames, and switch dynamic contrast and power saving off",
    measure=_sum_deviation(1), cause=Explanation("brightness", light_evidence),
)  # fmt: skip


def _code_value(value: Callable[[CodeAgreement], float]) -> Callable[[TableMeasurements], float | None]:
    return lambda table: None if table.lights.codes is None else value(table.lights.codes)


def _largest_angle(table: TableMeasurements) -> float | None:
    angles_deg_by_light = table.lights.off_codes_deg
    return None if angles_deg_by_light is None else float(angles_deg_by_light.max())


def _light_name(index: int, count: int) -> str:
    return f"illuminant {index}" if index < count else f"white frame {index - count}"


def _exchanges_text(table: TableMeasurements, accepted: float) -> str:
    codes, count = table.lights.codes, table.session.lights
    if codes is None or not codes.exchanges:
        return ""
    pairs = [f"{_light_name(pair.one, count)} and {_light_name(pair.other, count)}" for pair in codes.exchanges]
    separation = f"{codes.exchanges[0].angle_deg:.2g}°"
    omitted = f" (and {len(pairs) - _MAX_PAIRS} more pairs)" if len(pairs) > _MAX_PAIRS else ""
    return f"exchanged names: {', '.join(pairs[:_MAX_PAIRS])}{omitted}; angle of the first pair {separation}"


def _off_codes_text(table: TableMeasurements, accepted: float) -> str:
    lights, exchanges = table.lights.lights_off_codes(accepted), _exchanges_text(table, accepted)
    return f"{len(lights)} illuminants: {first_few(lights)}{f'; {exchanges}' if exchanges else ''}"


def _frames_off_codes(table: TableMeasurements, limit: float) -> list[FrameRecord]:
    lights = set(table.lights.lights_off_codes(limit))
    return [frame.record for frame in table.frames if frame.record.illumination in lights]


def _codes_row(table: TableMeasurements) -> SummaryRow | None:
    angle_deg = table.lights.off_codes_deg
    if angle_deg is None:
        return None
    worst = int(np.argmax(angle_deg))
    note = "angle between a white and its prediction from all other whites, minus four standard errors"
    return SummaryRow("Illuminants against codes", f"{angle_deg[worst]:.2f}° at most, illuminant {worst}", note)


OFF_CODES_DEG = Figure(
    "off_codes_deg", "Angle between an illuminant's white and its prediction from codes", "light", "°", "at most", 2.0,
    8.0,
    why="a frame has the name of another illuminant, or was taken before the projected image changed",
    source=SIMULATED + ": 0 without faults, and at least 28° if the list of frames is shifted by one row",
    remedy="correct the list of imported frames, let the projected image settle longer (sequence.settle_s), or "
    "expose whole turns of the colour wheel",
    foremost=True, measure=_largest_angle, where=_off_codes_text, retake=_frames_off_codes,
    cause=Explanation("names", name_evidence), drawing="lights", lines=(Line(220, _codes_row),),
)  # fmt: skip


def _brightness_text(table: TableMeasurements, accepted: float) -> str:
    codes = table.lights.codes
    if codes is None:
        return ""
    order = sorted(range(len(codes.off_brightness)), key=lambda light: -codes.off_brightness[light])
    beyond = [k for k in order if codes.off_brightness[k] > accepted]
    return first_few([f"illuminant {k} by {100 * codes.brightness[k]:+.0f} %" for k in beyond])


def _frames_off_brightness(table: TableMeasurements, limit: float) -> list[FrameRecord] | None:
    if table.lights.codes is None:
        return None
    off = table.lights.codes.off_brightness

    def light_of(frame: FrameMeasurements) -> int:
        return sys.maxsize if frame.record.illumination is None else frame.record.illumination

    return [frame.record for frame in table.frames if light_of(frame) < len(off) and off[light_of(frame)] > limit]


OFF_BRIGHTNESS = Figure(
    "off_brightness", "Deviation of an illuminant's brightness from the prediction from its codes", "light", "share",
    "at most", 0.1, 0.3,
    why="a frame has another exposure than its file records, or shows another illuminant",
    source=JUDGEMENT + ": more than the flicker of a lamp, and less than one step of the shutter time (26 %)",
    remedy="keep one exposure for the session, and take the frames again",
    measure=_code_value(lambda codes: float(codes.off_brightness.max())), where=_brightness_text,
    retake=_frames_off_brightness,
    cause=Explanation("brightness", brightness_evidence, follows=("off_codes_deg", "exchanged_lights")),
)  # fmt: skip

EXCHANGED_LIGHTS = Figure(
    "exchanged_lights", "Pairs of illuminants with exchanged names", "light", "", "at most", 0, None,
    why="the ground truths of two illuminants are correct, but each has the codes and the colour temperature of the "
    "other", source=SIMULATED + ": 0 without faults. Exchanges at a larger angle than exchange_deg are detected",
    remedy="correct the list of imported frames, or take both frames again",
    measure=_code_value(lambda codes: float(len(codes.exchanges))), where=_exchanges_text,
    cause=Explanation("names", name_evidence), drawing="lights",
)  # fmt: skip

CODE_MISFIT = Figure(
    "code_misfit", "Disagreement of all illuminants with their codes, for up to 24 illuminants", "light", "", "at most",
    1.0, None,
    why="at least one illuminant has wrong codes, but it cannot be identified",
    source=SIMULATED + ": χ² relative to its limit for correct codes. "
    "With more than 24 illuminants, each illuminant is judged separately",
    remedy="check that frames and illuminants belong together, and that the lamp was steady",
    before_session=False, measure=_code_value(lambda codes: codes.misfit), drawing="lights",
)  # fmt: skip

EXCHANGE_DEG = Figure(
    "exchange_deg", "Angle above which exchanged names are detected", "light", "°", "at most", 8.0, None,
    why="exchanged names of two illuminants at a smaller angle would not be detected",
    source=SIMULATED + ": 0.3° with 707 illuminants, and 0° with eight very different illuminants",
    remedy="take white and the primaries in the session, and expose longer",
    before_session=False, measure=_code_value(lambda codes: codes.exchange_deg), drawing="lights",
)  # fmt: skip


def _checked_text(table: TableMeasurements, accepted: float) -> str:
    codes = table.lights.codes
    return "" if codes is None else f"{int(codes.is_verified.sum())} of {len(codes.is_verified)}"


def _checked_row(table: TableMeasurements) -> SummaryRow | None:
    codes = table.lights.codes
    if codes is None:
        return None
    value = f"{_checked_text(table, 0.0)}; exchanged names detectable above {format_value(codes.exchange_deg, '°')}"
    note = "wrong names of illuminants that were not compared would not be detected"
    return SummaryRow("Illuminants compared with codes", value, note)


CROSS_CHECKED_SHARE = Figure(
    "cross_checked_share", "Illuminants that could be compared with their codes", "light", "share", "at least", 0.9,
    None,
    why="wrong names of illuminants that were not compared would not be detected",
    source=JUDGEMENT + ". An illuminant counts if a wrong name would be detected at angles of 8° and more",
    remedy="take white, red, green and blue in the session, and expose longer", before_session=False,
    measure=_code_value(lambda codes: float(codes.is_verified.mean())), where=_checked_text,
    lines=(Line(230, _checked_row),),
)  # fmt: skip

_WhiteValues = Callable[["CodeAgreement"], "npt.NDArray[np.float64]"]


def _white_frame_value(values_of: _WhiteValues) -> Callable[[TableMeasurements], float | None]:
    def measure(table: TableMeasurements) -> float | None:
        return None if table.lights.white_frames is None else float(values_of(table.lights.white_frames).max())

    return measure


def _white_frames_above(values_of: _WhiteValues) -> Callable[[TableMeasurements, float], list[FrameRecord]]:
    def beyond(table: TableMeasurements, limit: float) -> list[FrameRecord]:
        white = table.lights.white_frames
        values: list[float] = [] if white is None else values_of(white).tolist()
        return [frame.record for frame, value in zip(table.white_frames, values, strict=False) if value > limit]

    return beyond


_above_angle = _white_frames_above(lambda white: white.off_deg)
_above_brightness = _white_frames_above(lambda white: white.off_brightness)

WHITE_FRAME_DEG = Figure(
    "white_frame_deg", "Angle between a white frame and its prediction", "light", "°", "at most", 2.0, 8.0,
    why="the frame shows another illuminant than white, or the illuminants have wrong names",
    source=SIMULATED + ": 0 without faults",
    remedy="correct the list of imported frames, or take the white frame again",
    foremost=True, measure=_white_frame_value(lambda white: white.off_deg),
    where=lambda table, accepted: first_few([frame.file for frame in _above_angle(table, accepted)]),
    retake=_above_angle, cause=Explanation("names", name_evidence), drawing="frames",
)  # fmt: skip

WHITE_FRAME_BRIGHTNESS = Figure(
    "white_frame_brightness", "Deviation of a white frame's brightness from its prediction",
    "light", "share", "at most", 0.1, 0.3,
    why="the white frame has another exposure than the illuminants, so that drift and stray light are wrong",
    source=JUDGEMENT + ": more than the flicker of a lamp, and less than one step of the shutter time (26 %)",
    remedy="keep one exposure for the session, and take the white frame again",
    measure=_white_frame_value(lambda white: white.off_brightness),
    where=lambda table, accepted: first_few([frame.file for frame in _above_brightness(table, accepted)]),
    retake=_above_brightness, cause=Explanation("brightness", light_evidence), drawing="frames",
)  # fmt: skip


def _missing_primaries(table: TableMeasurements) -> float | None:
    if table.lights.codes is None:
        return None
    present = {light.index(max(light)) for light in table.session.codes if max(light) == sum(light) > 0}
    return float(3 - len(present)) if present else 0.0


def _primary_fields_row(table: TableMeasurements) -> SummaryRow | None:
    if table.primaries is not None or table.lights.codes is None:
        return None
    note = "no bright frames of red, green and blue alone; coloured patches get the flat field of paper"
    return SummaryRow("Fields of the primaries", "not measured", note)


PRIMARIES_LACKING = Figure(
    "primaries_lacking", "Primaries without a frame", "light", "", "at most", 0, None,
    why="the flat fields of the primaries were not measured, so that coloured patches get the flat field of paper",
    source="by definition. If the flat fields differ by 10 %, coloured patches at the corners have errors below 1 %",
    remedy="take red, green and blue alone in the session",
    before_session=False, measure=_missing_primaries, drawing="field", lines=(Line(240, _primary_fields_row),),
)  # fmt: skip


def _largest_tint(table: TableMeasurements) -> float | None:
    tint = table.greys.tints_deg(table.lights.white)
    return float(np.nanmax(tint)) if tint.size and np.isfinite(tint).any() and _shows_white(table) else None


def _tint_row(table: TableMeasurements) -> SummaryRow | None:
    if not table.greys.names:
        return None
    tints = zip(table.greys.names, table.greys.tints_deg(table.lights.white).tolist(), strict=True)
    note = (
        "angle to the camera RGB of bare paper; 1° to 2.5° if printed with the printer's profile, which is neutral "
        "for the eye and not for the camera; 4° to 8° if printed without colour management"
    )
    return SummaryRow("Tint of the greys", ", ".join(f"{name}: {angle:.2f}°" for name, angle in tints), note)


GREY_TINT_DEG = Figure(
    "grey_tint_deg", "Tint of the print's greys against paper", "radiometry", "°", "at most", 6.0, None,
    why="the ground truth is the colour of paper, so that methods that rely on grey have this error on images rendered "
    "by codes",
    source=JUDGEMENT + ". Simulated prints have 1° to 2.5° with the printer's profile, and 4.5° to 8° without it",
    remedy="render by colour (the default), which uses the measured print; or have the chart printed with the "
    "printer's profile (docs/printing.md)", measure=_largest_tint, from_one_frame="yes", lines=(Line(270, _tint_row),),
)  # fmt: skip
