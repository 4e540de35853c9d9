"""The accuracy of mixed lights: each light of a table is left out, mixed from the others, and compared with its frames.

`python -m benchmarks.mixtures [LUT]` prints one JSON object a line for each figure. Without a table it takes a session
of all 707 lights in the simulated room, with a chart of 512 colours before the small body, which takes minutes.

Two methods, neither of which uses the frames of the light left out except to compare:

codes    its proportion of the three primaries, known from the codes shown and the transfer function (sRGB), is mixed
         from those of its neighbours; the white and the colours that this mixture gives are a prediction.
match    its ground truth is asked for, as a user would; the white is then right by construction, the colours are a
         prediction, which fails if lights of one white differ in their spectra (metamerism).

The lights at the corners of the gamut are left out of both: the others cannot make them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.run.run import run_session
from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from experiment.chart.layout import A_SERIES_MM, design_chart
from experiment.config import LabSettings, SimulatedSettings
from experiment.lights import Illuminant, plan_illuminants, save_illuminants
from experiment.session.folder import Session
from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import InputError
from generator.lights.gamut import Gamut, Match

_Array = npt.NDArray[np.float64]
WELL_LIT_DN = 300


@dataclass(frozen=True, eq=False)
class Cells:
    """Means (L, C, 3) of the table's cells, and the variances of those means."""

    mean: _Array
    noise: _Array

    @classmethod
    def of(cls, lut: Lut) -> Cells:
        """Return the cells of a table; those listed as unfit are left out."""
        unfit = {cell.colour for cell in lut.provenance.unfit}
        fit = [colour for colour in range(lut.samples.shape[1]) if colour not in unfit]
        means: list[_Array] = []
        noises: list[_Array] = []
        for light in range(len(lut.white)):
            samples = lut.samples[light][fit].astype(np.float64)
            means.append(np.asarray(samples.mean(axis=1)))
            noises.append(np.asarray(samples.var(axis=1, ddof=1) / samples.shape[1]))
        return cls(np.array(means), np.array(noises))


@dataclass(frozen=True)
class LeftOut:
    """A light left out, and the mixture of others that replaces it."""

    light: int
    others: tuple[int, ...]
    weights: tuple[float, ...]


def report(name: str, value: float, unit: str, against: str) -> None:
    """Print one figure."""
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def drives(lights: Sequence[Illuminant]) -> _Array:
    """Return (L, 3) float64, the primaries' light as shares of full."""
    codes = [light.colour for light in lights]
    return decode_srgb(np.array(codes) / 255)


def leave_out(rgb: _Array) -> list[LeftOut]:
    """Return for each light that the others can make their mixture; `rgb` (L, 3) float64 is linear light."""
    found: list[LeftOut] = []
    for light in range(len(rgb)):
        others = np.delete(np.arange(len(rgb)), light)
        try:
            match: Match = Gamut(rgb[others]).match(rgb[light])
        except InputError:
            continue
        lights = tuple(int(others[number]) for number in match.mixture.lights)
        found.append(LeftOut(light, lights, match.mixture.weights))
    return found


def judge(method: str, found: Sequence[LeftOut], lut: Lut, cells: Cells) -> None:
    """Print the errors of predicted lights and colours against those measured."""
    angles: list[float] = []
    errors: list[_Array] = []
    noises: list[_Array] = []
    worst: list[float] = []
    summed, times = np.zeros(cells.mean.shape[1:]), np.zeros(cells.mean.shape[1:])
    for left in found:
        weights = np.asarray(left.weights)
        others = list(left.others)
        white = weights @ lut.white[others]
        angles.append(float(angles_deg(white, lut.white[left.light])))
        scale = lut.white[left.light] / white
        mean = np.tensordot(weights, cells.mean[others], 1) * scale
        real = cells.mean[left.light]
        lit = real > WELL_LIT_DN
        noise = (np.tensordot(weights**2, cells.noise[others], 1) * scale**2 + cells.noise[left.light]) / real**2
        error = mean / real - 1
        errors.append(error[lit])
        noises.append(noise[lit])
        summed += np.where(lit, error, 0)
        times += lit
        if lit.any():
            worst.append(float(np.sqrt((error[lit] ** 2).mean())))
    among = f"{len(found)} lights of {len(lut.white)}, each made of others"
    count = np.bincount([len(left.others) for left in found], minlength=4)
    report(f"{method}: lights in a mixture, mean", float((count @ np.arange(len(count))) / len(found)), "lights", among)
    report(f"{method}: white, median angle", float(np.median(angles)), "degrees", among)
    report(f"{method}: white, worst angle", float(np.max(angles)), "degrees", among)
    error, noise = np.concatenate(errors), np.concatenate(noises)
    rms = float(np.sqrt((error**2).mean()))
    alone = float(np.sqrt(noise.mean()))
    above = f"colour over white, cells above {WELL_LIT_DN} counts, {among}"
    report(f"{method}: colour means, RMS", 100 * rms, "%", above)
    report(f"{method}: colour means, RMS that noise alone gives", 100 * alone, "%", above)
    often = times >= len(found) / 4
    report(
        f"{method}: colour means, RMS of each colour's error averaged over lights, which takes the noise out",
        100 * float(np.sqrt(((summed[often] / times[often]) ** 2).mean())),
        "%",
        f"{int(often.sum())} channels of colours that are above {WELL_LIT_DN} counts under a quarter of the lights",
    )
    report(f"{method}: colour means, mean error", 100 * float(error.mean()), "%", above)
    report(f"{method}: colour means, RMS of the worst light", 100 * max(worst), "%", above)


def judge_black_bodies(lut: Lut) -> None:
    """Print how far a black body is from its two neighbours joined by mired."""
    bodies = sorted((light.cct_k, light.index) for light in lut.illuminations if light.cct_k is not None)
    angles: list[float] = []
    for (cold, first), (kelvin, light), (hot, second) in zip(bodies, bodies[1:], bodies[2:], strict=False):
        share = (1 / cold - 1 / kelvin) / (1 / cold - 1 / hot)
        joined = (1 - share) * lut.ground_truth[first] + share * lut.ground_truth[second]
        angles.append(float(angles_deg(joined, lut.white[light])))
    if angles:
        against = f"{len(angles)} black bodies between two others, twice as far apart as in use"
        report("black bodies: white, median angle", float(np.median(angles)), "degrees", against)
        report("black bodies: white, worst angle", max(angles), "degrees", against)


def small_table(folder: Path) -> Lut:
    """Return a table of all lights and 512 colours, photographed by the small body."""
    settings = LabSettings(
        rig="simulated",
        chart=folder / "chart.json",
        illuminations=folder / "illuminations.csv",
        simulated=SimulatedSettings(body="Test", seed=20, room={"waviness_mm": 0.5}),
    )
    design_chart(3, A_SERIES_MM["A5"], 20).save(settings.chart)
    save_illuminants(plan_illuminants(), settings.illuminations)
    run_session(settings, folder / "session", lambda done, total: None)
    with Session.open(folder / "session") as session:
        build(session, folder / "lut")
    return open_lut(folder / "lut")


def measure(lut: Lut) -> None:
    """Print the errors of one table."""
    cells = Cells.of(lut)
    judge("codes", leave_out(drives(lut.illuminations)), lut, cells)
    judge("match", leave_out(lut.white), lut, cells)
    judge_black_bodies(lut)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the errors of the table named, or of one made for the purpose, and return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", nargs="?", type=Path, help="folder of a table of many lights")
    folder: Path | None = parser.parse_args(argv).lut
    if folder is not None:
        measure(open_lut(folder))
        return 0
    with tempfile.TemporaryDirectory() as place:
        measure(small_table(Path(place)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
