"""Accept, accept with remarks, or refuse: a table's figures held against `calibration.verdict.thresholds`.

Laws that hold inside:

- Judging is a pure function of figures: the same figures give the same verdict, whoever measured them.
- A figure that could not be measured is not judged; one that is not a number is refused.
- The verdict is its worst row.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from calibration.checks.likeness import can_tell
from calibration.pipeline.linearity import curve
from calibration.pipeline.options import WINDOWS
from calibration.radiometry.greys import tint_deg
from calibration.sampling.samples import WINDOW
from calibration.verdict.thresholds import THRESHOLDS, Threshold
from foundation.angles import angles_deg
from foundation.errors import first_of

if TYPE_CHECKING:
    from calibration.pipeline.result import BuildResult
    from calibration.registration.register import Registration

SAFE_BLEED = 0.002
"""Share of a sample's light from beyond its cell that is taken for none."""

FORMAT = "crop.report"
VERSION = 1

Outcome = Literal["accept", "accept with remarks", "refuse"]
_OUTCOMES: tuple[Outcome, Outcome, Outcome] = ("accept", "accept with remarks", "refuse")
_REMEDIES = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less",
    "covered": "uncover the chart",
    "hot": "let the camera cool",
    "dead": "have the camera's pixels remapped",
    "stained": "clean the print or print it anew, and light it evenly",
    "uneven": "focus on the print and keep the camera still",
}
_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Judged:
    """One figure, its limit, and what follows."""

    threshold: Threshold
    value: float
    outcome: Outcome

    def text(self) -> str:
        """Return the figure with its limits, for a line of text."""
        limit, unit = self.threshold, self.threshold.unit
        refused = "" if limit.refuse is None else f", refused beyond {shown(limit.refuse, unit)}"
        return (
            f"{limit.title}: {shown(self.value, unit)}, {limit.sense} {shown(limit.accept, unit)} expected{refused}; "
            f"{limit.why}"
        )


@dataclass(frozen=True)
class Verdict:
    """What is thought of a table, figure by figure."""

    rows: tuple[Judged, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst of the rows."""
        return _OUTCOMES[max((_OUTCOMES.index(row.outcome) for row in self.rows), default=0)]

    @property
    def refused(self) -> tuple[Judged, ...]:
        """The rows for which no table is made."""
        return tuple(row for row in self.rows if row.outcome == "refuse")

    @property
    def remarks(self) -> tuple[Judged, ...]:
        """The rows to know of."""
        return tuple(row for row in self.rows if row.outcome == "accept with remarks")


def shown(value: float, unit: str) -> str:
    """Return a figure for people: shares as per cent, three significant digits."""
    if unit == "share":
        return f"{100 * value:.3g} %"
    if unit == "°":
        return f"{value:.2g}°"
    return f"{value:.3g} {unit}".strip() if abs(value) < 1000 else f"{value:.0f} {unit}".strip()


def judge(figures: Mapping[str, float], thresholds: Sequence[Threshold] = THRESHOLDS) -> Verdict:
    """Return the verdict on figures by name; a limit whose figure is missing is passed over."""
    return Verdict(
        tuple(
            Judged(limit, figures[limit.name], _outcome(figures[limit.name], limit))
            for limit in thresholds
            if limit.name in figures
        )
    )


def _outcome(value: float, limit: Threshold) -> Outcome:
    if math.isnan(value):
        return "refuse" if limit.refuse is not None else "accept with remarks"
    sign = 1 if limit.sense == "at most" else -1
    if limit.refuse is not None and sign * value > sign * limit.refuse:
        return "refuse"
    return "accept with remarks" if sign * value > sign * limit.accept else "accept"


def figures_of(result: BuildResult) -> dict[str, float]:
    """Return the figures of a build or a check that are judged, by name."""
    registration = result.registration
    tags = len(registration.framing.tags)
    white = np.array([frame.paper.white for frame in result.frames if frame.record.kind == "white"]).reshape(-1, 3)
    spread = [
        float(frame.paper.spread[int(np.argmax(frame.paper.white))])
        for frame in result.frames
        if frame.record.kind == "white"
    ]
    errors = truth_errors_deg(result.white, result.white_error)
    paper = result.white.max(axis=1)
    used = min((frame.paper.references for frame in result.frames), default=0)
    figures = {
        "cell_px": registration.cell_px,
        "bleed": bleed(registration.cell_px, registration.blur_px, result.window),
        "tag_residual_px": registration.lens_residual_px,
        "tag_final_px": registration.marks_rms_px / registration.room,
        "block_residual_px": registration.block_rms_px / registration.room,
        "blocks_good": float(registration.blocks.good.mean()),
        "agreement": registration.agreement,
        "unfit_share": len(result.unfit) / max(len(registration.strangers), 1),
        "softer_bleed": max(
            (_bleed_beyond(registration, frame.blur_px, result.window) for frame in result.frames), default=0.0
        ),
        "black_drift_counts": result.black_drift,
        "references_used": used / max(result.white_references, 1),
        "truth_median_deg": float(np.median(errors)),
        "truth_worst_deg": float(errors.max()),
        "brightest_share": float(paper.max()) / result.white_level,
        "darkest_counts": float(paper.min()),
    }
    if result.stains.tells:
        figures["doubtful_share"] = float(result.stains.doubtful.mean())
    if len(result.frames) > 1:
        figures["moved_anew"] = float(sum(frame.registered for frame in result.frames))
    if can_tell(len(registration.strangers)):
        figures["unlike_scatter"] = max((frame.likeness.scatter for frame in result.frames), default=0.0)
        figures["unlike_block"] = max((frame.likeness.block for frame in result.frames), default=0.0)
    if registration.framing.field is None:
        figures["tags_found"] = tags / max(tags + len(registration.framing.missing), 1)
    full = white.mean(axis=0) if len(white) else result.white[int(np.argmax(result.white.sum(axis=1)))]
    if np.isfinite(result.darkness.light).all() and result.subtracted is None:
        figures["leak_share"] = float(np.abs(result.darkness.light / full).max())
    if len(result.darkness.lights) > 1:
        figures["dark_drift"] = float((np.ptp(result.darkness.lights, axis=0) / full).max())
    if result.linearity is not None:
        figures["linearity"] = result.linearity.worst
    if result.added is not None:
        figures["additivity"] = float(np.abs(result.added).max())
    if result.off_codes_deg is not None:
        figures["off_codes_deg"] = float(result.off_codes_deg.max())
    if (tint := grey_tints_deg(result)).size and np.isfinite(tint).any():
        figures["grey_tint_deg"] = float(np.nanmax(tint))
    if result.transfer is not None:
        figures["noise_misfit"] = float(result.transfer.misfit.max())
        figures["noisy_share"] = float(result.transfer.noisy.mean())
    if len(white) > 1:
        figures["white_drift"] = result.white_drift
        figures["white_drift_deg"] = float(angles_deg(white, np.broadcast_to(white[0], white.shape)).max())
    if spread:
        figures["reference_spread"] = max(spread)
    return figures


def grey_tints_deg(result: BuildResult) -> _Array:
    """Return the angle (G,) between each level of grey and white, degrees, in the light with most of all channels."""
    if not len(result.grey_names):
        return np.zeros(0)
    best = int(np.argmax(result.white.min(axis=1)))
    return tint_deg(result.white[best], result.greys[best])


def bleed(cell_px: float, blur_px: float, window: int = WINDOW) -> float:
    """Return the share of the worst sample's light that comes from beyond its cell.

    A Gaussian of σ `blur_px`, integrated beyond the nearest edge, for the outermost of `window` pixels (2 px from the
    middle one of 5) with 0.5 px of rounding and 0.25 px of registration against it.
    """
    from scipy.special import ndtr

    return float(ndtr(-(cell_px / 2 - window // 2 - 0.75) / max(blur_px, 1e-3)))


def _bleed_beyond(registration: Registration, blur_px: float, window: int) -> float:
    """Return how much more light a frame's worst sample has from beyond its cell than that of the registered frame."""
    return bleed(registration.cell_px, blur_px, window) - bleed(registration.cell_px, registration.blur_px, window)


def largest_window(cell_px: float, blur_px: float) -> int:
    """Return the largest window of which no sample has more than 0.2 % of its light from elsewhere; 0 if there is none.

    Facts of the print's geometry: 5 on the EOS 550D, 7 on the 6D Mark II, for cells of 10.2 and 12.4 px, σ = 0.7 px.
    """
    return max((window for window in WINDOWS if bleed(cell_px, blur_px, window) <= SAFE_BLEED), default=0)


def truth_errors_deg(white: _Array, error: _Array) -> _Array:
    """Return the standard error (L,) of the direction of ground truths (L, 3) with standard errors (L, 3), degrees.

    The mean square angle of a vector with small independent errors: each error's part across the vector.
    """
    length = np.linalg.norm(white, axis=1, keepdims=True)
    along = white / np.maximum(length, 1e-9)
    across = np.sqrt((error**2 * (1 - along**2)).sum(axis=1))
    return np.degrees(across / np.maximum(length[:, 0], 1e-9))


def refusal(verdict: Verdict, result: BuildResult) -> str:
    """Return why there is no table and what helps, in a line."""
    worst = verdict.refused[0]
    remedy = worst.threshold.remedy
    more = f" (and {len(verdict.refused) - 1} more)" if len(verdict.refused) > 1 else ""
    detail = ""
    if worst.threshold.name == "unfit_share":
        causes: dict[str, int] = {}
        for cell in result.unfit:
            name = cell.cause.split(":")[0]
            causes[name] = causes.get(name, 0) + 1
        cause = max(causes, key=lambda name: causes[name])
        detail, remedy = f", {causes[cause]} of them {cause}", _REMEDIES.get(cause, "look at the report")
    return f"{with_place(worst, result)}{detail}{more}; {remedy}, and take the session anew"


def with_place(row: Judged, result: BuildResult) -> str:
    """Return a figure against its limit, and where the worst of it is."""
    place = _where(row, result)
    return f"{row.text()}, {place}" if place else row.text()


def _where(row: Judged, result: BuildResult) -> str:
    """Return in which frame or lights the worst of a figure is, and where on the print; "" where it has no place."""
    match row.threshold.name:
        case "softer_bleed":
            softest = max(result.frames, key=lambda frame: frame.blur_px)
            return f"in {softest.record.file}, blurred by {softest.blur_px:.2f} px"
        case "unlike_scatter":
            return f"in {max(result.frames, key=lambda frame: frame.likeness.scatter).record.file}"
        case "unlike_block":
            frame = max(result.frames, key=lambda frame: frame.likeness.block)
            x_mm, y_mm = frame.likeness.at_mm
            return f"in {frame.record.file} about {x_mm:.0f}, {y_mm:.0f} mm"
        case "off_codes_deg":
            lights = lights_off_codes(result, row.threshold.accept)
            return f"{len(lights)} lights: {first_of(lights)}"
        case _:
            return ""


def lights_off_codes(result: BuildResult, accept_deg: float) -> list[int]:
    """Return the lights whose white is further than that off what their codes give, the furthest first."""
    off = np.zeros(0) if result.off_codes_deg is None else result.off_codes_deg
    return [int(light) for light in np.argsort(-off) if off[light] > accept_deg]


def _channels(result: BuildResult) -> dict[str, Any]:
    """Return what is known for each channel, for `report.json`; what could not be measured is null."""
    transfer, dark = result.transfer, result.darkness

    def told(values: _Array | None) -> list[float | None] | None:
        if values is None:
            return None
        return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]

    return {
        "window": result.window,
        "largest_window": largest_window(result.registration.cell_px, result.registration.blur_px),
        "linearity": None if result.linearity is None else curve(result.linearity),
        "dark_frames": len(dark.files),
        "dark_subtracted": result.subtracted is not None,
        "dark_counts": told(dark.light),
        "dark_error": told(dark.error),
        "dark_noise": told(dark.noise),
        "additivity": told(result.added),
        "gain_e_per_count": told(None if transfer is None else transfer.gain_e),
        "read_noise_counts": told(None if transfer is None else transfer.read_noise),
        "response_spread": told(None if transfer is None else transfer.response),
        "noisy_colours": [] if transfer is None else np.flatnonzero(transfer.noisy).tolist(),
        "grey_tint_deg": dict(zip(result.grey_names, told(grey_tints_deg(result)) or [], strict=True)),
    }


def report_json(result: BuildResult) -> dict[str, Any]:
    """Return the content of `report.json`: verdict, figures, and every limit with its reason."""
    figures = figures_of(result)
    verdict = judge(figures)
    return {
        "format": FORMAT,
        "version": VERSION,
        "verdict": verdict.outcome,
        "session": result.session.name,
        "camera": result.camera,
        "lights": result.lights,
        "channels": _channels(result),
        "off_codes_deg": None
        if result.off_codes_deg is None
        else [float(f"{angle:.3g}") for angle in result.off_codes_deg.tolist()],
        "primaries_differ": None if result.primaries is None else float(f"{result.primaries.difference:.3g}"),
        "figures": {name: float(f"{value:.6g}") for name, value in figures.items()},
        "limits": [asdict(row.threshold) | {"outcome": row.outcome} for row in verdict.rows],
    }
