"""The report for programs: `report.json`, whose form is stated in docs/formats.md."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.checks.light_codes import CodeAgreement
from calibration.figures.table_figures import TableFigures
from calibration.sampling import largest_window
from calibration.table.lut import REPORT_FORMAT, REPORT_VERSION
from calibration.verdict.result import BuildResult
from calibration.verdict.retaking import findings, retake_command, retake_json, retaken_frames
from calibration.verdict.values import judged_values

PLACES = (7, 5)
"""Points across and down the page whose places are told: enough to see how it hung, and how it bent, roughly."""

_Array = npt.NDArray[np.float64]


def report_json(result: BuildResult) -> dict[str, Any]:
    """Return the content of `report.json`: verdict, figures, and every limit with its reason."""
    figures, verdict = result.figures, result.verdict
    off_codes_deg, primaries = figures.lights.off_codes_deg, figures.primaries
    return {
        "format": REPORT_FORMAT,
        "version": REPORT_VERSION,
        "verdict": verdict.outcome,
        "session": figures.session.folder.name,
        "camera": figures.session.camera,
        "lights": figures.session.lights,
        "channels": _channels(figures),
        "chart_places": _chart_places(figures),
        "geometry": _geometry(figures),
        "lens": figures.lens.to_json() | ({} if figures.point_spread is None else figures.point_spread.to_json()),
        "off_codes_deg": None if off_codes_deg is None else _short(off_codes_deg),
        "codes": None if figures.lights.codes is None else _codes(figures.lights.codes),
        "origin": figures.origin.model_dump(mode="json"),
        "origins": _origins(figures),
        "primaries_differ": None if primaries is None else float(f"{primaries.difference:.3g}"),
        "figures": {name: _rounded(value) for name, value in judged_values(figures).items()},
        "causes": _causes(result),
        **retake_json(retaken_frames(verdict, figures), _registered_sha256(figures), _newest_sha256(figures)),
        "limits": [asdict(row.threshold) | {"outcome": row.outcome} for row in verdict.rows],
    }


def _causes(result: BuildResult) -> list[dict[str, Any]]:
    """Return what each figure beyond its limit is probably caused by, and what that was decided from."""
    return [
        {
            "figure": name,
            "cause": found.decision.cause.name,
            "follows": found.decision.follows,
            "why": "" if found.decision.rule is None else found.decision.rule.why,
            "remedy": found.decision.cause.remedy,
            "mends": found.decision.cause.mends,
            "command": retake_command(found.frames) if found.is_of_frames else "",
            "files": [frame.file for frame in found.frames],
            "places": [
                {
                    "file": place.file,
                    "x_mm": _rounded(place.x_mm),
                    "y_mm": _rounded(place.y_mm),
                    "size_mm": _rounded(place.size_mm),
                }
                for place in found.places
            ],
            "evidence": {known: _rounded(value) for known, value in found.evidence.known().items()},
        }
        for name, found in findings(result.verdict, result.figures).items()
    ]


def _registered_sha256(figures: TableFigures) -> str:
    """Return the hash of the frame that was registered first; of another where that one is not among those measured."""
    named = [frame for frame in figures.frames if frame.record.file == figures.session.registered_file]
    return (named or figures.frames)[0].record.sha256


def _newest_sha256(figures: TableFigures) -> str:
    """Return the hash of the measured frame that was taken last."""
    return max((frame.record for frame in figures.frames), key=lambda record: record.attempt).sha256


def _chart_places(figures: TableFigures) -> dict[str, Any]:
    """Return where points of the page lie in the frame that was registered first, half-size px.

    Of two tables of one chart these tell how it hung elsewhere.
    """
    registration = figures.registration
    width, height = registration.colours.page_mm
    across, down = PLACES
    points = [(x, y) for y in np.linspace(0.05, 0.95, down) * height for x in np.linspace(0.05, 0.95, across) * width]
    return {
        "frame": figures.session.registered_file,
        "mm": np.round(points, 3).tolist(),
        "px": np.round(registration.to_pixels(points), 3).tolist(),
    }


def _geometry(figures: TableFigures) -> dict[str, Any]:
    """Return how well cells' places are known, and where red and blue lie against green, half-size px."""
    registration = figures.registration
    inner, outer = registration.places_known_px
    lateral = registration.lateral
    return {
        "uncertainty_px": _rounded(inner),
        "rim_uncertainty_px": _rounded(outer),
        "lateral_corner_px": {channel: _rounded(lateral.corner_px(channel)) for channel in ("R", "B")},
        "lateral_error_px": {channel: _rounded(lateral.corner_error_px(channel)) for channel in ("R", "B")},
    }


def _codes(codes: CodeAgreement) -> dict[str, Any]:
    """Return how the lights agree with their codes, light by light."""
    return {
        "angle_deg": _short(codes.angle_deg),
        "error_deg": _short(codes.error_deg),
        "brightness": _short(codes.brightness),
        "off_brightness": _short(codes.off_brightness),
        "seen_as": {str(light): int(codes.seen_as[light]) for light in np.flatnonzero(codes.seen_as >= 0).tolist()},
        "exchanges": [asdict(pair) for pair in codes.exchanges],
        "held": int(codes.held.sum()),
        "exchange_deg": _rounded(codes.exchange_deg),
        "misfit": _rounded(codes.misfit),
    }


def _origins(figures: TableFigures) -> dict[str, Any]:
    """Return which frames' files state another camera, lens or exposure than most."""
    origins = figures.origins
    named = {
        "other_camera": origins.other_camera,
        "other_lens": origins.other_lens,
        "other_exposure": origins.other_exposure,
    }
    return {
        name: [{"file": frame.record.file, "found": frame.found, "expected": frame.expected} for frame in frames]
        for name, frames in named.items()
    }


def _short(values: _Array) -> list[float]:
    return [float(f"{value:.3g}") for value in values.tolist()]


def _channels(figures: TableFigures) -> dict[str, Any]:
    """Return what is known for each channel; what could not be measured is null."""
    transfer, dark, lights = figures.sensor.transfer, figures.dark_frames, figures.lights
    linearity, registration = figures.sensor.linearity, figures.registration
    return {
        "window": figures.cells.window,
        "largest_window": largest_window(registration.cell_px, registration.blur_px),
        "linearity": None if linearity is None else linearity.to_json(),
        "dark_frames": len(dark.files),
        "dark_subtracted": lights.subtracted is not None,
        "dark_counts": _numbers(dark.light),
        "dark_error": _numbers(dark.error),
        "dark_noise": _numbers(dark.noise),
        "additivity": None if lights.additivity is None else _numbers(lights.additivity),
        "stray": None if lights.stray is None else lights.stray.to_json(),
        "gain_e_per_count": _numbers(transfer.gain_e),
        "read_noise_counts": _numbers(transfer.read_noise),
        "response_spread": _numbers(transfer.response),
        "noisy_colours": np.flatnonzero(transfer.noisy).tolist(),
        "grey_tint_deg": dict(zip(figures.greys.names, _numbers(figures.greys.tints_deg(lights.white)), strict=True)),
    }


def _numbers(values: _Array) -> list[float | None]:
    """Return values (N,) with six significant digits; None for what is not finite, which JSON cannot hold."""
    return [_rounded(value) if np.isfinite(value) else None for value in values.tolist()]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
