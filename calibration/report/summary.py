"""The figures that say how good a table is, as rows for people: name, value, and what the value means or is usual."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.checks.stray_light import CERTAIN
from calibration.figures.table_figures import LightFigures, TableFigures
from calibration.sampling import SAFE_BLEED, bleed, largest_window
from experiment.framing.visibility import MIN_CELL_PX
from experiment.measures.sensor_range import MAX_BLACK_DRIFT


@dataclass(frozen=True)
class SummaryRow:
    """A figure in words.

    - `name`: what was measured.
    - `value`: the figure with its unit.
    - `note`: what it means, or what is usual; may be "".
    - `brief`: whether it is among the few that a command prints.
    """

    name: str
    value: str
    note: str
    brief: bool = False


def summary(figures: TableFigures) -> list[SummaryRow]:
    """Return the figures that say how good a table is, in the order of the report."""
    return [
        *_registration_rows(figures),
        *_course_rows(figures),
        *_sensor_rows(figures),
        *_light_rows(figures),
        SummaryRow(
            "Cells unfit for use", str(len(figures.cells.unfit)), "listed in lut.json, never filled", brief=True
        ),
    ]


def _registration_rows(figures: TableFigures) -> list[SummaryRow]:
    """Return where and how well the chart was found."""
    registration, window = figures.registration, figures.cells.window
    plain = registration.framing.field is not None
    tags = len(registration.framing.tags)
    found = "the chart has none" if plain else f"{tags} of {tags + len(registration.framing.missing)}"
    marks = "outline of the field, across" if plain else "corners of the tags"
    usual = "" if plain else "; the detector's own error is 0.09"
    return [
        SummaryRow("Lights", str(figures.session.lights), "with an accepted frame"),
        SummaryRow("Frame registered", figures.session.registered_file, ""),
        SummaryRow("Tags found", found, "", brief=True),
        SummaryRow(
            "Shorter side of a cell",
            f"{registration.cell_px:.1f} px",
            f"of the half-size frame; {MIN_CELL_PX:g} or more for 25 pixels inside it",
        ),
        SummaryRow("Window", f"{window}×{window} samples", _window_note(figures)),
        SummaryRow("Blur", f"σ {registration.blur_px:.2f} px", "about 0.6 is sharp"),
        SummaryRow("Spread of the lens", *_lens(figures)),
        SummaryRow(
            "Residual of the outline" if plain else "Residual of tags",
            f"{registration.marks_rms_px:.3f} px RMS",
            f"{marks} against the final map{usual}",
        ),
        SummaryRow(
            "Residual of plane and lens",
            f"{registration.lens_residual_px:.2f} px RMS",
            f"{marks} against a plane seen through a lens: the waviness of the sheet",
        ),
        SummaryRow(
            "Residual of cell blocks",
            f"{registration.block_rms_px:.3f} px RMS",
            "displacement of blocks of cells that the final map leaves",
            brief=True,
        ),
        SummaryRow(
            "Correlation with the chart",
            f"{registration.agreement:.4f}",
            "of the cells' colours with the chart's; with another chart's about 0",
            brief=True,
        ),
    ]


def _lens(figures: TableFigures) -> tuple[str, str]:
    """Return what the lens spreads beside its sharp core, and what is done about it."""
    lens = figures.lens
    if not lens.measured:
        return "not measured", lens.why_not
    veil = f"a veil of {100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    dark = f"{100 * lens.left_worst:.2g} % in cells of {100 * lens.worst_level:.2g} % of paper"
    left = f"{100 * lens.left:.2g} % RMS, {dark},"
    if not lens.corrected and not lens.beyond_cell:
        return "none", f"{lens.why_not}; {veil} is likeliest, and {left} is what may be in cells' means"
    done = f"subtracted, {left} may be left" if lens.corrected else f"not subtracted: {lens.why_not}"
    size = f"{100 * lens.rms:.2g} % RMS, {100 * lens.worst:.2g} % at most"
    return size, f"of cells' means above 300 counts, relative to paper, {veil} in it; {done}"


def _course_rows(figures: TableFigures) -> list[SummaryRow]:
    """Return how chart and lamp changed from frame to frame; of one frame alone, as a check reads, nothing."""
    rows: list[SummaryRow] = []
    if len(figures.frames) > 1:
        again = sum(frame.reregistered for frame in figures.frames)
        rows.append(
            SummaryRow(
                "Movement of the chart",
                f"{figures.largest_shift_px:.3f} px at most",
                f"{again} frames registered again",
                brief=True,
            )
        )
    if len(figures.white_frames) > 1:
        rows.append(
            SummaryRow(
                "Drift of white", _percent(figures.white_drift), "between white frames; 1 % is usual", brief=True
            )
        )
    black = np.mean([frame.black for frame in figures.frames], axis=0)
    drift = f"drift {figures.black_drift:.2f} counts, up to {MAX_BLACK_DRIFT:g} is usual"
    return [*rows, SummaryRow("Black level", f"{black.mean():.2f} counts", drift)]


def _sensor_rows(figures: TableFigures) -> list[SummaryRow]:
    """Return how the sensor answers to light."""
    sensor, white = figures.sensor, figures.lights.white.max(axis=1)
    gain = " / ".join(f"{value:.2f}" for value in sensor.transfer.gain_e.tolist())
    read = " / ".join(f"{value:.1f}" for value in sensor.transfer.read_noise.tolist())
    source = (
        "measured in cells"
        if sensor.saturation_measured
        else "as the raw files state it, which may be too high; no photosite of a cell reached it"
    )
    return [
        SummaryRow(
            "Saturation", f"{sensor.white_level} counts above black", f"{source}; bare paper reaches {white.max():.0f}"
        ),
        SummaryRow("Darkest light", f"{white.min():.0f} counts", "its strongest channel on bare paper"),
        SummaryRow("Noise of a sample", _percents(sensor.noise), "R, G, B, of paper under white"),
        SummaryRow(
            "Photon transfer",
            f"{gain} e⁻ per count, {read} counts of read noise",
            f"R, G, B of half-size pixels; {int(sensor.transfer.noisy.sum())} cells are noisier than the curve",
        ),
        _linearity_row(figures),
    ]


def _linearity_row(figures: TableFigures) -> SummaryRow:
    linearity = figures.sensor.linearity
    if linearity is None:
        return SummaryRow("Linearity", "not measured", "give a series of exposures of the chart with --linearity")
    low, high = linearity.range
    return SummaryRow(
        "Linearity",
        f"{_percent(linearity.worst)} from a straight line at most",
        f"{len(linearity.files)} exposures, {low:.0%} to {high:.0%} of saturation; 1 % is usual",
    )


def _light_rows(figures: TableFigures) -> list[SummaryRow]:
    """Return what whites, dark frames, primaries and greys show."""
    lights = figures.lights
    share = lights.white_error / np.maximum(lights.white, 1e-9)
    rows = [
        SummaryRow(
            "Standard error of the ground truth",
            f"{_percent(float(np.median(share)))} of a channel, median",
            "of the mean of the white references",
            brief=True,
        )
    ]
    if len(lights.share_at_zero):
        worst = int(np.argmax(lights.share_at_zero))
        rows.append(
            SummaryRow(
                "Samples at 0",
                f"{100 * lights.share_at_zero.mean():.3f} %, {_percent(lights.share_at_zero[worst])} under light "
                f"{worst}",
                "no light within the noise; negative values are cut to 0, which lifts the mean of such cells a little",
            )
        )
    rows += _dark_rows(figures)
    if lights.off_codes_deg is not None:
        worst = int(np.argmax(lights.off_codes_deg))
        rows.append(
            SummaryRow(
                "Lights against their codes",
                f"{lights.off_codes_deg[worst]:.2f}° at most, light {worst}",
                "angle between a white and what all other lights predict from its codes, beyond four standard errors",
            )
        )
    if lights.codes is not None:
        held, down_to = int(lights.codes.held.sum()), lights.codes.exchange_deg
        rows.append(
            SummaryRow(
                "Lights held against their codes",
                f"{held} of {len(lights.codes.held)}; exchanged names excluded down to {down_to:.2g}°",
                "the others are too few, or too dim, for a wrong name to be noticed",
            )
        )
    if figures.primaries is None and lights.codes is not None:
        rows.append(
            SummaryRow(
                "Fields of the primaries",
                "not measured",
                "no frames of red, green and blue, each alone and bright enough; coloured cells are evened by paper's",
            )
        )
    if lights.codes is not None:
        rows.append(_stray_row(lights))
    if lights.additivity is not None:
        rows.append(
            SummaryRow("Red + green + blue − white", _percents(lights.additivity), "R, G, B, of white; 0 is additive")
        )
    if figures.greys.names:
        tints = zip(figures.greys.names, figures.greys.tints_deg(lights.white).tolist(), strict=True)
        rows.append(
            SummaryRow(
                "Tint of the greys",
                ", ".join(f"{name}: {angle:.2f}°" for name, angle in tints),
                "angle to bare paper's camera RGB; a print through the printer's profile has 1° to 2.5°, for it is "
                "neutral to the eye and not to the camera, one of plain ink codes 4° to 8°",
            )
        )
    return rows


def _stray_row(lights: LightFigures) -> SummaryRow:
    """Return what light single frames have beyond the dark ones, and how many lights could be asked."""
    stray = lights.stray
    if stray is None:
        return SummaryRow(
            "Light that no dark frame shows",
            "not measured",
            "red, green and blue alone and a dark frame show it",
        )
    return SummaryRow(
        "Light that no dark frame shows",
        f"{_percent(stray.share)} of white",
        f"beyond {CERTAIN:g} standard errors; {int(stray.checked.sum())} of {len(stray.certain)} lights are checked by "
        "a code of 0, the primaries against white; of the others it is not known",
    )


def _dark_rows(figures: TableFigures) -> list[SummaryRow]:
    """Return what light there is while the projector shows black."""
    dark, white = figures.dark_frames, [frame.paper.white for frame in figures.white_frames]
    if not dark.files or not white:
        return []
    counts = " / ".join(f"{value:.2f}" for value in dark.light.tolist())
    done = "not subtracted" if figures.lights.subtracted is None else "subtracted from samples and ground truth"
    return [
        SummaryRow(
            "Light while the projector shows black",
            f"{counts} counts, {_percents(dark.light / np.mean(white, axis=0))} of white",
            f"R, G, B of leak and ambient light on bare paper, {len(dark.files)} dark frames; {done}",
        )
    ]


def _window_note(figures: TableFigures) -> str:
    """Return what windows the cells allow."""
    registration, window = figures.registration, figures.cells.window
    largest = largest_window(registration.cell_px, registration.blur_px)
    safe = f"{100 * SAFE_BLEED:g} %"
    if window > largest:
        share = bleed(registration.cell_px, registration.blur_px, window)
        allowed = f"{largest}×{largest} has less than {safe}" if largest else f"no window has less than {safe}"
        return f"too large: {100 * share:.2g} % of the worst sample's light is from beyond its cell; {allowed}"
    return f"up to {largest}×{largest}, at most {safe} of a sample's light is from beyond its cell"


def _percent(value: float) -> str:
    return f"{100 * value:.2f} %"


def _percents(values: npt.NDArray[np.floating]) -> str:
    """Return values of R, G and B (3,) float64, shares, as per cent."""
    return " / ".join(f"{100 * value:.2f}" for value in values.tolist()) + " %"
