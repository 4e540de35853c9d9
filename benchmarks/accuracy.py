"""The accuracy of a table: built from sessions of full-size frames in simulated rooms, and compared with the rooms.

`python -m benchmarks.accuracy` prints one JSON object a line for each figure: for both cameras in the default room, for
one where the lamp fades by 3 % and the projector's light falls off by 30 %, and there again with primaries that fall
off differently, which white paper alone does not show. Takes some ten minutes.

A mean of 25 samples has noise, 1 % at 300 counts, which no table can be without. What matters is the error
beyond it. So the noise that light and sensor must have is predicted for every cell, and the systematic error is the
root of mean square error less mean square noise (`beyond_noise`); its uncertainty comes from the spread over lights,
since errors within a light are correlated.
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
from benchmarks import words_given
from benchmarks.sessions import stated_of_cells
from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from drivers.camera import ExposureSettings
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.config import LabSettings, SequenceSettings, SimulatedSettings
from experiment.lights import Illumination, plan_illuminations, save_illuminations
from experiment.session.folder import Session
from foundation.colorimetry import angles_deg
from sim.world.sensors import BODIES, Body
from sim.world.world import World

WELL_LIT_DN = 300
BINS_DN = ((300, 1000), (1000, 3000), (3000, 20000))
# Photosites in a sample of red, green and blue.
PHOTOSITES = np.array([1, 2, 1])

Changes = Mapping[str, bool | int | float | str]
UNEVEN: Changes = {"lamp_drift_per_hour": 3.8, "projector_falloff": 0.3}
UNLIKE: Changes = {"lamp_drift_per_hour": 3.8, "projector_falloff": 0.3, "vignetting": 0.3, "primary_difference": 0.2}

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


def report(name: str, value: float, unit: str, against: str) -> None:
    """Print one figure."""
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


@dataclass(frozen=True, eq=False)
class TableErrors:
    """The errors of a table against the room that it was taken in.

    - `level`: (L, C, 3) float64, the true mean of each cell in the table's counts.
    - `error`: (L, C, 3) float64, measured over true, less 1.
    - `noise`: (L, C, 3) float64, standard deviation that `error` has from photons and read noise alone.
    - `scatter`: (L, C, 3) float64, variance of the 25 samples over that of photons, read noise and the photosites'
      response.
    - `clean`: (C,) bool, cells that are fit for use.
    """

    level: _Array
    error: _Array
    noise: _Array
    scatter: _Array
    clean: _Mask

    def where(self, low: float, high: float) -> _Mask:
        """Return (L, C, 3) whether a mean is of a fit cell and lies within a range of counts."""
        return (self.level >= low) & (self.level < high) & self.clean[None, :, None]


def sample_variance(counts: _Array, body: Body, iso: int = 100, response: float = 0.0) -> _Array:
    """Return the variance (..., 3) of one sample of light (..., 3), counts above black: EMVA 1288's model.

    `response` is the standard deviation of the photosites' response, which neighbours show as noise.
    """
    photosite = counts / body.gain_e(iso) + body.noise_dn(iso) ** 2 + (response * counts) ** 2
    return photosite / PHOTOSITES


def table_errors(
    lut: Lut, world: World, chart: Chart, fields: Sequence[_Array], exposure: ExposureSettings
) -> TableErrors:
    """Return the errors of a table against its room, which must have no light but the projector's (`Room.ambient`).

    `fields`: for each light (C, 3), the field that was divided out: with it the counts that the noise was made of are
    known.
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
        # Rounding to whole counts adds a twelfth.
        alone = sample_variance(counts, world.body, exposure.iso) / fields[number] ** 2 + 1 / 12
        noise[number] = np.sqrt(alone / samples.shape[1]) / level[number]
        spread = sample_variance(counts, world.body, exposure.iso, world.room.response_spread)
        scatter[number] = samples.var(axis=1, ddof=1) / (spread / fields[number] ** 2 + 1 / 12)
    clean = np.ones(chart.colour_count, dtype=np.bool_)
    clean[[cell.colour for cell in lut.provenance.unfit]] = False
    return TableErrors(level, error, noise, scatter, clean)


def beyond_noise(error: _Array, noise: _Array, chosen: _Mask) -> tuple[float, float, float, float]:
    """Return RMS of errors, RMS of the noise in them, what is beyond it, and its upper bound (two standard errors).

    `error`, `noise`: (L, C, 3) errors and the standard deviation that each has by itself. `chosen`: (L, C, 3) bool,
    which to use.
    """
    square, known = error**2, noise**2
    lights = [light for light in range(len(error)) if chosen[light].any()]
    weights = np.array([chosen[light].sum() for light in lights], dtype=np.float64)
    excess = np.array([(square - known)[light][chosen[light]].mean() for light in lights])
    mean = float(np.average(excess, weights=weights))
    spread = float(np.sqrt(np.average((excess - mean) ** 2, weights=weights) / max(len(lights) - 1, 1)))
    total, alone = (float(np.sqrt(values[chosen].mean())) for values in (square, known))
    return total, alone, float(np.sqrt(max(mean, 0))), float(np.sqrt(max(mean + 2 * spread, 0)))


def repeated_variance(
    one: npt.NDArray[np.uint16], other: npt.NDArray[np.uint16], counts: _Array, field: _Array, body: Body, iso: int
) -> _Array:
    """Return (C, 3), the variance between two frames of one light over that of photons and read noise.

    The difference of two frames is free of all that stands still: response, bleed, unevenness.

    `one`, `other`: (C, 25, 3) samples of the two. `counts`, `field`: (C, 3) true counts, field included, and the field.
    """
    measured = (one.astype(np.float64) - other).var(axis=1, ddof=1) / 2
    return measured / (sample_variance(counts, body, iso) / field**2 + 1 / 12)


def lights_with_repeats() -> tuple[Illumination, ...]:
    """Return twelve lights, the brightest mixture and a primary twice."""
    lights = plan_illuminations(grid=2, ccts_k=(2500, 4000, 5500, 7500))
    repeated = (*lights, lights[9], lights[0])
    return tuple(replace(light, index=index) for index, light in enumerate(repeated))


def measure(case: str, body: str, room: Changes, folder: Path) -> None:
    """Take and build one session, and print its errors."""
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
    save_illuminations(lights, settings.illuminations)
    run_session(settings, folder / "session", lambda done, total: None)
    with Session.open(folder / "session") as session:
        result = build(session, folder / "lut")
    lut = open_lut(folder / "lut")
    world = World(sheet(chart), simulated_body(settings), simulated_room(settings))
    exposure, cells = settings.camera.exposure, chart.centres_mm[chart.cell_of_colour]

    found = result.figures.registration.to_pixels(chart.centres_mm)
    offset = np.linalg.norm(found - world.project(chart.centres_mm), axis=1)
    report(f"{case}: cell centres, RMS", float(np.sqrt((offset**2).mean())), "px", "World.project")
    report(f"{case}: cell centres, worst of {len(offset)}", float(offset.max()), "px", "World.project")

    truth = np.array([world.white(light.colour, exposure) for light in lights])
    degrees = angles_deg(truth, lut.white)
    report(
        f"{case}: ground truth, median angle",
        float(np.median(degrees)),
        "degrees",
        f"World.white, {len(lights)} lights",
    )
    report(f"{case}: ground truth, worst angle", float(degrees.max()), "degrees", f"World.white, {len(lights)} lights")
    stated, stated_cells = lut.truth_uncertainty_deg, stated_of_cells(lut)
    assert stated is not None
    for name, value in (("median", np.median(stated)), ("worst", stated.max())):
        report(f"{case}: ground truth, {name} stated", float(value), "degrees, k = 2", "uncertainty.csv")
    report(f"{case}: cells, RMS stated", 100 * float(np.sqrt((stated_cells**2).mean())), "%, k = 2", "cells.csv")

    frames = {frame.record.illumination: frame for frame in result.figures.frames if frame.record.kind == "light"}
    fields = [frames[number].paper.field.at(cells) for number in range(len(lights))]
    errors = table_errors(lut, world, chart, fields, exposure)
    against = "World.reflected over World.white, noise by EMVA 1288 taken out"
    for low, high in ((WELL_LIT_DN, np.inf), *BINS_DN):
        chosen = errors.where(low, high)
        total, alone, systematic, bound = beyond_noise(errors.error, errors.noise, chosen)
        name = (
            f"{case}: cell means, {low} counts and more" if high == np.inf else f"{case}: cell means, {low} to {high}"
        )
        report(f"{name}, relative error, RMS", 100 * total, "%", "World.reflected over World.white")
        report(f"{name}, noise of 25 samples in it", 100 * alone, "%", "EMVA 1288 model")
        report(f"{name}, systematic error, RMS", 100 * systematic, "%", against)
        report(f"{name}, systematic error, upper bound", 100 * bound, "%", "two standard errors over lights")
        scatter = errors.scatter[chosen]
        report(
            f"{name}, variance of samples, mean over cells",
            float(scatter.mean()),
            "of the true",
            "photons, read noise and the photosites' response",
        )

    # One lamp for all lights: samples over the gain, against a lamp that never fades.
    drift = next(done for done in lut.provenance.corrections if done["name"] == "drift")
    gains = np.array(drift["per_light"])
    report(f"{case}: the lamp's drift over the session", 100 * float(np.ptp(gains, axis=0).max()), "%", "white frames")
    shape = world.field(cells)
    report(
        f"{case}: light of the darkest cell", 100 * float((shape / shape.max(axis=0)).min()), "%", "brightest cell's"
    )
    mean_field = shape.mean()
    level = np.array([lut.white[n] / gains[n] / truth[n] for n in range(len(lights))]) / mean_field
    lit = truth * mean_field > WELL_LIT_DN
    report(
        f"{case}: brightness of lights after drift correction, RMS",
        100 * float(np.sqrt(((level / np.median(level[lit]) - 1)[lit] ** 2).mean())),
        "%",
        "World.white under a steady lamp, up to one factor",
    )
    for one, other in ((9, len(lights) - 2), (0, len(lights) - 1)):
        ratio = repeated_variance(
            lut.samples[one], lut.samples[other], errors.level[one] * fields[one], fields[one], world.body, exposure.iso
        )
        for low, high in ((30, 300), *BINS_DN):
            chosen = (errors.level[one] >= low) & (errors.level[one] < high) & errors.clean[:, None]
            if chosen.sum() > 1000:
                report(
                    f"{case}: variance between two frames of light {one}, {low} to {high} counts",
                    float(ratio[chosen].mean()),
                    "of the true",
                    "photons and read noise alone",
                )
    report(f"{case}: cells unfit", len(lut.provenance.unfit), "cells", f"{chart.colour_count} cells")
    report(f"{case}: remarks", len(result.verdict.remarks), "rows", result.verdict.outcome)


def main() -> int:
    """Measure both full-size bodies in the default room, and one where light is uneven and fades."""
    words_given(__doc__)
    cases: list[tuple[str, str, Changes]] = [(body, body, {}) for body in BODIES if body != "Test"]
    cases.append(("EOS 550D, uneven and fading light", "EOS 550D", UNEVEN))
    cases.append(("EOS 550D, unlike primaries", "EOS 550D", UNLIKE))
    for case, body, room in cases:
        with tempfile.TemporaryDirectory() as folder:
            measure(case, body, room, Path(folder))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
