"""Accuracy of mixed illuminants: each illuminant of a LUT is predicted from the others and compared with its frames.

`python -m benchmarks.mixtures [LUT]` prints one JSON object per result and line. Without a LUT it takes a session of
all 707 illuminants in the simulated room, with a chart of 512 colours and the small body, which takes minutes.

Two methods predict an illuminant from its neighbours. Both use the frames of this illuminant only for the comparison:

codes    mixes the neighbours so that the proportions of the three primaries are equal to those of the illuminant. They
         are calculated from the codes and the transfer function (sRGB). White and colours are predicted.
match    mixes the neighbours so that the mixture has the ground truth of the illuminant, as a user would. Only the
         colours are predicted. The prediction fails if illuminants with equal white have other spectra (metamerism).

Illuminants at the corners of the gamut are excluded, because no mixture of the others can reach them.
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
    """Means (L, C, 3) of the patches of a LUT, and the variances of these means."""

    mean: _Array
    noise: _Array

    @classmethod
    def of(cls, lut: Lut) -> Cells:
        """Return the patches of a LUT without those listed as unfit."""
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
    """An illuminant and the mixture of others that predicts it."""

    light: int
    others: tuple[int, ...]
    weights: tuple[float, ...]


def report(name: str, value: float, unit: str, against: str) -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def drives(lights: Sequence[Illuminant]) -> _Array:
    """Return the light of the primaries (L, 3) float64, relative to full drive."""
    codes = [light.colour for light in lights]
    return decode_srgb(np.array(codes) / 255)


def leave_out(rgb: _Array) -> list[LeftOut]:
    """Predict each illuminant that the others can reach; `rgb` (L, 3) float64 is linear light."""
    predictions: list[LeftOut] = []
    for light in range(len(rgb)):
        others = np.delete(np.arange(len(rgb)), light)
        try:
            match: Match = Gamut(rgb[others]).match(rgb[light])
        except InputError:
            continue
        lights = tuple(int(others[number]) for number in match.mixture.lights)
        predictions.append(LeftOut(light, lights, match.mixture.weights))
    return predictions


def judge(method: str, predictions: Sequence[LeftOut], lut: Lut, cells: Cells) -> None:
    """Print the errors of predicted illuminants and colours."""
    angles: list[float] = []
    errors: list[_Array] = []
    noises: list[_Array] = []
    worst: list[float] = []
    error_sums, lit_counts = np.zeros(cells.mean.shape[1:]), np.zeros(cells.mean.shape[1:])
    for prediction in predictions:
        weights = np.asarray(prediction.weights)
        others = list(prediction.others)
        white = weights @ lut.white[others]
        angles.append(float(angles_deg(white, lut.white[prediction.light])))
        scale = lut.white[prediction.light] / white
        mean = np.tensordot(weights, cells.mean[others], 1) * scale
        real = cells.mean[prediction.light]
        lit = real > WELL_LIT_DN
        noise = (np.tensordot(weights**2, cells.noise[others], 1) * scale**2 + cells.noise[prediction.light]) / real**2
        error = mean / real - 1
        errors.append(error[lit])
        noises.append(noise[lit])
        error_sums += np.where(lit, error, 0)
        lit_counts += lit
        if lit.any():
            worst.append(float(np.sqrt((error[lit] ** 2).mean())))
    scope = f"{len(predictions)} of {len(lut.white)} illuminants, each predicted from others"
    count = np.bincount([len(prediction.others) for prediction in predictions], minlength=4)
    report(
        f"{method}: illuminants per mixture, mean",
        float((count @ np.arange(len(count))) / len(predictions)),
        "illuminants",
        scope,
    )
    report(f"{method}: white, median angle", float(np.median(angles)), "degrees", scope)
    report(f"{method}: white, worst angle", float(np.max(angles)), "degrees", scope)
    error, noise = np.concatenate(errors), np.concatenate(noises)
    rms = float(np.sqrt((error**2).mean()))
    noise_rms = float(np.sqrt(noise.mean()))
    colour_scope = f"colour / white, patches above {WELL_LIT_DN} counts, {scope}"
    report(f"{method}: colour means, RMS", 100 * rms, "%", colour_scope)
    report(f"{method}: colour means, RMS of the noise alone", 100 * noise_rms, "%", colour_scope)
    frequent = lit_counts >= len(predictions) / 4
    report(
        f"{method}: colour means, RMS of errors averaged over illuminants (without noise)",
        100 * float(np.sqrt(((error_sums[frequent] / lit_counts[frequent]) ** 2).mean())),
        "%",
        f"{int(frequent.sum())} channels of colours above {WELL_LIT_DN} counts under a quarter of the illuminants",
    )
    report(f"{method}: colour means, mean error", 100 * float(error.mean()), "%", colour_scope)
    report(f"{method}: colour means, RMS of the worst illuminant", 100 * max(worst), "%", colour_scope)


def judge_black_bodies(lut: Lut) -> None:
    """Print the error of each black body interpolated from its two neighbours by mired."""
    bodies = sorted((light.cct_k, light.index) for light in lut.illuminations if light.cct_k is not None)
    angles: list[float] = []
    for (cold, first), (kelvin, light), (hot, second) in zip(bodies, bodies[1:], bodies[2:], strict=False):
        share = (1 / cold - 1 / kelvin) / (1 / cold - 1 / hot)
        interpolated = (1 - share) * lut.ground_truth[first] + share * lut.ground_truth[second]
        angles.append(float(angles_deg(interpolated, lut.white[light])))
    if angles:
        against = f"{len(angles)} black bodies between two others, at twice the usual distance"
        report("black bodies: white, median angle", float(np.median(angles)), "degrees", against)
        report("black bodies: white, worst angle", max(angles), "degrees", against)


def small_table(folder: Path) -> Lut:
    """Return a LUT of all illuminants and 512 colours, photographed by the small body."""
    settings = LabSettings(
        rig="simulated",
        chart=folder / "chart.json",
        illuminations=folder / "illuminations.csv",
        simulated=SimulatedSettings(body="Test", seed=20, room={"waviness_mm": 0.5}),
    )
    design_chart(3, A_SERIES_MM["A5"], 20).save(settings.chart)
    save_illuminants(plan_illuminants(), settings.illuminations)
    run_session(settings, folder / "session", lambda count, total: None)
    with Session.open(folder / "session") as session:
        build(session, folder / "lut")
    return open_lut(folder / "lut")


def measure(lut: Lut) -> None:
    cells = Cells.of(lut)
    judge("codes", leave_out(drives(lut.illuminations)), lut, cells)
    judge("match", leave_out(lut.white), lut, cells)
    judge_black_bodies(lut)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the errors of the given LUT, or of a new one, and return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", nargs="?", type=Path, help="folder of a LUT with many illuminants")
    folder: Path | None = parser.parse_args(argv).lut
    if folder is not None:
        measure(open_lut(folder))
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        measure(small_table(Path(scratch)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
