"""Accuracy of a LUT that is built from sessions of full-size frames in simulated rooms.

`python -m benchmarks.accuracy` prints one JSON object per result, each on its own line. It measures both cameras in the
default room. One camera is also measured in two other rooms: in the first the lamp fades by 3 % and the projector has a
fall-off of 30 %; in the second the primaries have different fall-offs, which white paper alone cannot show. It takes
about ten minutes.

The mean of 25 samples has noise of 1 % at 300 counts. Every LUT has this noise, so only errors beyond the noise count.
The noise of light and sensor is predicted for every patch. The systematic error is the square root of the mean square
error minus the mean square noise (`beyond_noise`). Its uncertainty is the scatter over illuminants, because errors
under one illuminant are correlated.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.run.rig.simulated import sheet, simulated_body, simulated_room
from acquisition.run.run import run_session
from benchmarks import parse_words
from benchmarks.sessions import patch_uncertainty
from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from drivers.camera import ExposureSettings
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.config import LabSettings, SequenceSettings, SimulatedSettings
from experiment.lights import Illuminant, plan_illuminants, save_illuminants
from experiment.session.folder import Session
from foundation.colorimetry import angles_deg
from sim.world.sensors import BODIES, Body
from sim.world.world import World

WELL_LIT_DN = 300
BINS_DN = ((300, 1000), (1000, 3000), (3000, 20000))
# Photosites per sample in red, green and blue.
PHOTOSITES = np.array([1, 2, 1])

Changes = Mapping[str, bool | int | float | str]
UNEVEN: Changes = {"lamp_drift_per_hour": 3.8, "projector_falloff": 0.3}
UNLIKE: Changes = {"lamp_drift_per_hour": 3.8, "projector_falloff": 0.3, "vignetting": 0.3, "primary_difference": 0.2}

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


def report(name: str, value: float, unit: str, against: str) -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


@dataclass(frozen=True, eq=False)
class TableErrors:
    """Errors of a LUT, compared with the simulated room of its session."""

    level: _Array  # (L, C, 3), true mean of each patch, in counts of the LUT
    error: _Array  # (L, C, 3), measured mean / true mean − 1
    noise: _Array  # (L, C, 3), standard deviation of `error` from photons and read noise alone
    scatter: _Array  # (L, C, 3), variance of the 25 samples / that of photons, read noise and response
    clean: _Mask  # (C,), patches that are fit for use

    def where(self, low: float, high: float) -> _Mask:
        """Select the means of fit patches within a range of counts: (L, C, 3) bool."""
        return (self.level >= low) & (self.level < high) & self.clean[None, :, None]


def sample_variance(counts: _Array, body: Body, iso: int = 100, response: float = 0.0) -> _Array:
    """Return the variance (..., 3) of one sample, by the model of EMVA 1288.

    `counts` (..., 3) are above black. `response` is the standard deviation of the photosite response.
    """
    photosite = counts / body.gain_e(iso) + body.noise_dn(iso) ** 2 + (response * counts) ** 2
    return photosite / PHOTOSITES


def table_errors(
    lut: Lut, world: World, chart: Chart, fields: Sequence[_Array], exposure: ExposureSettings
) -> TableErrors:
    """Compare a LUT with its room. The room must have no ambient light (`Room.ambient`).

    `fields` holds the flat field (C, 3) of each illuminant; it converts LUT values to sensor counts.
    """
    codes = chart.rgb[chart.cell_of_colour]
    shape = (*lut.samples.shape[:2], 3)
    level, error, noise, scatter = (np.zeros(shape) for _ in range(4))
    for number, light in enumerate(lut.illuminations):
        samples = lut.samples[number].astype(np.float64)
        relative = world.reflected(codes, light.colour, exposure) / world.white(light.colour, exposure)
        level[number] = relative * lut.white[number]
        counts = level[number] * fields[number]
        error[number] = samples.mean(axis=1) / level[number] - 1
        # Rounding to whole counts adds a variance of 1/12.
        variance = sample_variance(counts, world.body, exposure.iso) / fields[number] ** 2 + 1 / 12
        noise[number] = np.sqrt(variance / samples.shape[1]) / level[number]
        full_variance = sample_variance(counts, world.body, exposure.iso, world.room.response_spread)
        scatter[number] = samples.var(axis=1, ddof=1) / (full_variance / fields[number] ** 2 + 1 / 12)
    clean = np.ones(chart.colour_count, dtype=np.bool_)
    clean[[cell.colour for cell in lut.provenance.unfit]] = False
    return TableErrors(level, error, noise, scatter, clean)


def beyond_noise(error: _Array, noise: _Array, selected: _Mask) -> tuple[float, float, float, float]:
    """Separate the systematic error from the noise.

    `error`, `noise` (L, C, 3): relative errors and the standard deviation of their noise. `selected` (L, C, 3) bool:
    values to use. Returns the RMS error, the RMS noise, the systematic RMS error and its upper bound (two standard
    errors).
    """
    square, noise_square = error**2, noise**2
    used_lights = [light for light in range(len(error)) if selected[light].any()]
    weights = np.array([selected[light].sum() for light in used_lights], dtype=np.float64)
    excess = np.array([(square - noise_square)[light][selected[light]].mean() for light in used_lights])
    mean = float(np.average(excess, weights=weights))
    spread = float(np.sqrt(np.average((excess - mean) ** 2, weights=weights) / max(len(used_lights) - 1, 1)))
    total_rms, noise_rms = (float(np.sqrt(values[selected].mean())) for values in (square, noise_square))
    return total_rms, noise_rms, float(np.sqrt(max(mean, 0))), float(np.sqrt(max(mean + 2 * spread, 0)))


def repeated_variance(
    first_samples: npt.NDArray[np.uint16],
    second_samples: npt.NDArray[np.uint16],
    counts: _Array,
    field: _Array,
    body: Body,
    iso: int,
) -> _Array:
    """Return the variance between two frames of one illuminant, divided by that of photons and read noise: (C, 3).

    The difference of two frames contains no fixed pattern (response, bleed, fall-off). The samples are (C, 25, 3);
    `counts` (C, 3) are the true counts before division by the flat field.
    """
    measured = (first_samples.astype(np.float64) - second_samples).var(axis=1, ddof=1) / 2
    return measured / (sample_variance(counts, body, iso) / field**2 + 1 / 12)


def lights_with_repeats() -> tuple[Illuminant, ...]:
    """Plan twelve illuminants; the brightest mixture and one primary occur twice."""
    lights = plan_illuminants(grid=2, ccts_k=(2500, 4000, 5500, 7500))
    repeated = (*lights, lights[9], lights[0])
    return tuple(replace(light, index=index) for index, light in enumerate(repeated))


def measure(case: str, body: str, room: Changes, folder: Path) -> None:
    """Take and build one session and print its errors."""
    settings = LabSettings(
        rig="simulated",
        chart=folder / "chart.json",
        illuminations=folder / "illuminations.csv",
        simulated=SimulatedSettings(body=body, seed=20, room=dict(room)),
        sequence=SequenceSettings(reference_every=4, warm_up_s=0),
    )
    chart = design_chart(seed=20)
    chart.save(settings.chart)
    lights = lights_with_repeats()
    save_illuminants(lights, settings.illuminations)
    run_session(settings, folder / "session", lambda count, total: None)
    with Session.open(folder / "session") as session:
        result = build(session, folder / "lut")
    lut = open_lut(folder / "lut")
    world = World(sheet(chart), simulated_body(settings), simulated_room(settings))
    exposure, cells = settings.camera.exposure, chart.centres_mm[chart.cell_of_colour]

    detected_px = result.figures.registration.to_pixels(chart.centres_mm)
    offset = np.linalg.norm(detected_px - world.project(chart.centres_mm), axis=1)
    report(f"{case}: patch centres, RMS", float(np.sqrt((offset**2).mean())), "px", "World.project")
    report(f"{case}: patch centres, worst of {len(offset)}", float(offset.max()), "px", "World.project")

    truth = np.array([world.white(light.colour, exposure) for light in lights])
    degrees = angles_deg(truth, lut.white)
    report(
        f"{case}: ground truth, median angle",
        float(np.median(degrees)),
        "degrees",
        f"World.white, {len(lights)} lights",
    )
    report(f"{case}: ground truth, worst angle", float(degrees.max()), "degrees", f"World.white, {len(lights)} lights")
    uncertainty_deg, reported_errors = lut.truth_uncertainty_deg, patch_uncertainty(lut)
    assert uncertainty_deg is not None
    for name, value in (("median", np.median(uncertainty_deg)), ("worst", uncertainty_deg.max())):
        report(f"{case}: ground truth, {name} reported uncertainty", float(value), "degrees, k = 2", "uncertainty.csv")
    report(
        f"{case}: patches, RMS of the reported uncertainty",
        100 * float(np.sqrt((reported_errors**2).mean())),
        "%, k = 2",
        "cells.csv",
    )

    frames = {frame.record.illumination: frame for frame in result.figures.frames if frame.record.kind == "light"}
    fields = [frames[number].paper.field.at(cells) for number in range(len(lights))]
    errors = table_errors(lut, world, chart, fields, exposure)
    against = "World.reflected / World.white, EMVA 1288 noise subtracted"
    for low, high in ((WELL_LIT_DN, np.inf), *BINS_DN):
        selected = errors.where(low, high)
        total, noise_rms, systematic, bound = beyond_noise(errors.error, errors.noise, selected)
        name = (
            f"{case}: patch means, {low} counts or more" if high == np.inf else f"{case}: patch means, {low} to {high}"
        )
        report(f"{name}, relative error, RMS", 100 * total, "%", "World.reflected / World.white")
        report(f"{name}, noise of 25 samples", 100 * noise_rms, "%", "EMVA 1288 model")
        report(f"{name}, systematic error, RMS", 100 * systematic, "%", against)
        report(f"{name}, systematic error, upper bound", 100 * bound, "%", "two standard errors over illuminants")
        scatter = errors.scatter[selected]
        report(
            f"{name}, variance of samples, mean over patches",
            float(scatter.mean()),
            "ratio",
            "photons, read noise and the photosites' response",
        )

    # The same lamp is used for all illuminants: samples / gain are compared with a lamp that does not fade.
    drift = next(correction for correction in lut.provenance.corrections if correction["name"] == "drift")
    gains = np.array(drift["per_light"])
    report(f"{case}: lamp drift over the session", 100 * float(np.ptp(gains, axis=0).max()), "%", "white frames")
    shape = world.field(cells)
    report(f"{case}: light, darkest patch", 100 * float((shape / shape.max(axis=0)).min()), "%", "brightest patch")
    mean_field = shape.mean()
    level = np.array([lut.white[n] / gains[n] / truth[n] for n in range(len(lights))]) / mean_field
    lit = truth * mean_field > WELL_LIT_DN
    report(
        f"{case}: brightness of illuminants after drift correction, RMS",
        100 * float(np.sqrt(((level / np.median(level[lit]) - 1)[lit] ** 2).mean())),
        "%",
        "World.white with a constant lamp, up to one common factor",
    )
    for first, repeat in ((9, len(lights) - 2), (0, len(lights) - 1)):
        ratio = repeated_variance(
            lut.samples[first],
            lut.samples[repeat],
            errors.level[first] * fields[first],
            fields[first],
            world.body,
            exposure.iso,
        )
        for low, high in ((30, 300), *BINS_DN):
            selected = (errors.level[first] >= low) & (errors.level[first] < high) & errors.clean[:, None]
            if selected.sum() > 1000:
                report(
                    f"{case}: variance between two frames of illuminant {first}, {low} to {high}",
                    float(ratio[selected].mean()),
                    "ratio",
                    "photons and read noise alone",
                )
    report(f"{case}: unfit patches", len(lut.provenance.unfit), "patches", f"{chart.colour_count} patches")
    report(f"{case}: remarks", len(result.verdict.remarks), "rows", result.verdict.outcome)


def main() -> int:
    """Measure both full-size bodies in the default room, and one in two rooms with uneven and fading light."""
    parse_words(__doc__)
    cases: list[tuple[str, str, Changes]] = [(body, body, {}) for body in BODIES if body != "Test"]
    cases.append(("EOS 550D, uneven and fading light", "EOS 550D", UNEVEN))
    cases.append(("EOS 550D, unlike primaries", "EOS 550D", UNLIKE))
    for case, body, room in cases:
        with tempfile.TemporaryDirectory() as folder:
            measure(case, body, room, Path(folder))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
