"""Screen levers of rendering on three real cameras in minutes, without tables on the disk: a short cut of worth.sh.

The camera's response to each cell of the simulated print is computed for the projector's three primaries; a light with
a given chromaticity is the one mixture of them that has it. A thumbnail's pixel is the mean of the cells that dithering
would put there, so that there is neither noise of dithering nor of the sensor. Everything else is that of the commands:
lights of the other half of the camera's images, learners of the suite, cross-validation over the whole camera, pooled
ratios with bootstrap intervals paired by image, means over the seeds.

    python examples/screening.py --pictures BSDS500/data/images --pictures imagenet-sample-images \
        --archives ARCHIVES --lever naive-matrix --lever random-like

ARCHIVES is the folder with the three cameras' thumbnails, as examples/worth.sh has it.

Levers: naive, naive-matrix; codes; and keep, compensate, random (the print's black), each of colorimetric rendering
under the projector's white, with -neutral (the 75 % of the pictures whose mean is most neutral) or -like (pictures
weighted to the grey-world offsets of the other half's images); relit: real scenes of the other cameras.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import Delaunay, cKDTree
from scipy.stats import gaussian_kde

from evaluation.experiments.bootstrap import STATISTICS, ErrorSample, Statistic, bounded_figures, safe_ratio
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.standard import standard_learners
from evaluation.metrics import recovery_error
from foundation.colorimetry import decode_srgb
from generator.rendering.matrices import camera_matrix
from sim.spectral import print_reflectance, projector_primaries, read_sensitivities

Floats = npt.NDArray[Any]

# Archive, sensitivities, colour matrix, and what the names of its images contain.
CAMERAS = {
    "600D": ("nus_canon_600d_64x64.npz", "Canon_EOS_600D", "Canon EOS 600D", "Canon"),
    "1Ds Mark III": ("nus_canon_1ds_mk3_64x64.npz", "Canon_EOS-1Ds_Mark_III", "Canon EOS-1Ds Mark III", "Canon"),
    "5DSR": ("intel_tau_5dsr_64x64.npz", "Canon_EOS_5DS", "Canon EOS 5DS R", "field"),
}

LINEAR = decode_srgb(np.arange(256) / 255)
WIDTH = 32
CODES = np.rint(np.arange(WIDTH) * 255 / (WIDTH - 1)).astype(np.int64)
SIDE, SMALL = 128, 64
# White point of the target over the paper's white, and the most of the print's black that is taken out.
WHITE, VEIL = 0.97, 0.97


@dataclass(frozen=True, eq=False)
class Real:
    """A camera's real images: (N, 64, 64, 3) float32 and their lights (N, 3), sum 1."""

    images: Floats
    lights: Floats

    def halves(self) -> tuple[Floats, Floats]:
        """Return the places of two halves, by seed 0."""
        order = np.random.default_rng(0).permutation(len(self.lights))
        middle = len(order) // 2
        return np.sort(order[:middle]), np.sort(order[middle:])

    def offsets(self) -> Floats:
        """Return the grey-world offsets (N, 2): ln R/G and ln B/G of the mean over the light."""
        return np.array(
            [_offset(x[x.max(2) > 0].mean(0) / light) for x, light in zip(self.images, self.lights, strict=True)]
        )


def read_real(folder: Path, name: str) -> Real:
    """Return a camera's archive."""
    archive, _, _, part = CAMERAS[name]
    with np.load(folder / archive) as content:
        chosen = np.array([part in name for name in content["names"].tolist()])
        images, lights = content["images"][chosen].astype(np.float32), content["gt"][chosen].astype(np.float64)
    return Real(images / images.max(axis=(1, 2, 3), keepdims=True), lights / lights.sum(axis=1, keepdims=True))


def read_pictures(folders: Sequence[Path]) -> Floats:
    """Return the pictures of folders, (N, 128, 128, 3) uint8, squashed to a square as the real thumbnails are."""
    files = [path for folder in folders for path in sorted(folder.rglob("*"))]
    made: list[Any] = []
    for path in files:
        picture = cv2.imread(str(path)) if path.suffix.lower() in (".jpg", ".jpeg", ".png") else None
        if picture is not None:
            square = cv2.resize(picture[..., ::-1], (160, 160), interpolation=cv2.INTER_AREA)
            made.append(cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_AREA))
    return np.array(made)


def _offset(colour: Floats) -> Floats:
    return np.log(colour[..., [0, 2]] / colour[..., 1:2])


def _halved(pixels: Floats) -> Floats:
    return pixels.reshape(SMALL, 2, SMALL, 2, -1).mean(axis=(1, 3))


class Print:
    """What a camera sees of the simulated print under the projector's primaries."""

    def __init__(self, name: str) -> None:
        seen = read_sensitivities(CAMERAS[name][1]).at(np.arange(380.0, 781.0, 5.0))
        red, green, blue = np.meshgrid(CODES, CODES, CODES, indexing="ij")
        self.codes: Floats = np.stack([red.ravel(), green.ravel(), blue.ravel()], axis=1)
        responses: Floats = np.einsum(
            "pl,nl,lc->pnc", projector_primaries(), print_reflectance(self.codes), seen, optimize=True
        )
        self.responses: Floats = responses / responses[:, -1].sum(axis=0)[1]
        self.paper: Floats = self.responses[:, -1]
        matrix = camera_matrix(CAMERAS[name][2])
        if matrix is None:
            raise ValueError(name)
        self.matrix: Floats = matrix.rows

    def weights(self, light: Floats) -> Floats:
        """Return the weights (3,) of the primaries under which paper has a light's chromaticity; none below 0."""
        solve: Any = np.linalg.solve
        return np.maximum(solve(self.paper.T, light / light[1]), 0)

    def node_responses(self, colorimetric: bool) -> Floats:
        """Return the mean responses (32768, 9) float32 to each node of source codes, primaries by channels."""
        if not colorimetric:
            return self.responses.transpose(1, 0, 2).reshape(-1, 9).astype(np.float32)
        white = self.paper.sum(axis=0)
        seen = np.tensordot(self.weights(white / white.sum()), self.responses, 1)
        seen = seen / seen[-1]
        black = seen[0].mean()
        wanted = black + (WHITE - black) * np.clip(np.maximum(LINEAR[self.codes] @ self.matrix.T, 0), 0, 1)
        mesh: Any = Delaunay(seen)
        simplex = mesh.find_simplex(wanted)
        places = mesh.transform[simplex]
        shares = np.einsum("kij,kj->ki", places[:, :3], wanted - places[:, 3])
        weights = np.concatenate([shares, 1 - shares.sum(axis=1, keepdims=True)], axis=1)
        cells = mesh.simplices[simplex].copy()
        outside = simplex < 0
        if outside.any():
            nearest: Any = cKDTree(np.cbrt(seen)).query(np.cbrt(wanted[outside]))
            cells[outside], weights[outside] = nearest[1][:, None], 0.25
        weights = np.clip(weights, 0, None)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.einsum("kj,pkjc->kpc", weights, self.responses[:, cells]).reshape(-1, 9).astype(np.float32)


def nodes_of(picture: Floats, rng: np.random.Generator, linear: bool) -> Floats:
    """Return a node for each pixel (H, W) of a picture (H, W, 3) uint8, drawn so that the mean is kept."""
    if not linear:
        level = np.clip(np.floor(picture.astype(np.float32) * 31 / 255.0 + rng.random(picture.shape)), 0, 31).astype(
            int
        )
    else:
        low = np.minimum(np.floor(picture.astype(np.float32) * 31 / 255.0).astype(int), 30)
        below, above = LINEAR[CODES[low]], LINEAR[CODES[low + 1]]
        level = low + (rng.random(picture.shape) < (LINEAR[picture] - below) / (above - below))
    return (level[..., 0] * WIDTH + level[..., 1]) * WIDTH + level[..., 2]


class Training:
    """Training images of one lever for one camera."""

    def __init__(self, lever: str, pictures: Floats, seen: Print, real: Real, others: Sequence[Real]) -> None:
        self.rendering, _, self.choice = lever.partition("-")
        self.seen, self.real, self.others = seen, real, others
        rng, made = np.random.default_rng(0), []
        if self.rendering == "naive":
            matrix = seen.matrix if self.choice == "matrix" else np.eye(3)
            linear = [np.maximum(LINEAR[picture] @ matrix.T, 0) for picture in pictures]
            made = [_halved(image) for image in linear]
        elif self.rendering != "relit":
            dithered = self.rendering != "codes"
            responses = seen.node_responses(dithered)
            made = [_halved(responses[nodes_of(picture, rng, dithered)]) for picture in pictures]
        # Images are relit anew each time.
        self.images: Floats = np.array(made).astype(np.float16)

    def make(self, lights: Floats, other: Floats, rng: np.random.Generator) -> tuple[list[Floats], Floats]:
        """Return an image for each light (N, 3), and its truth; `other` holds the places of the half that was seen."""
        if self.rendering == "relit":
            scenes = [x / light for some in self.others for x, light in zip(some.images, some.lights, strict=True)]
            order = np.concatenate([rng.permutation(len(scenes)) for _ in range(len(lights) // len(scenes) + 1)])
            made = [scenes[place] * light for place, light in zip(order, lights, strict=False)]
            return [(image / image.max()).astype(np.float32) for image in made], lights
        count = len(self.images)
        if self.choice == "like":
            own, wanted = self._offsets(0.5 if self.rendering == "random" else 0), self.real.offsets()[other]
            density: Any = gaussian_kde(wanted.T)(own.T) / np.maximum(gaussian_kde(own.T)(own.T), 1e-3)
            density = np.minimum(density, np.quantile(density, 0.98))
            chosen = rng.choice(count, len(lights), p=density / density.sum())
        else:
            pool = np.arange(count)
            if self.choice == "neutral":
                pool = np.argsort(np.hypot(*self._offsets(VEIL).T))[: count * 3 // 4]
            chosen = np.concatenate([rng.permutation(pool) for _ in range(len(lights) // len(pool) + 1)])[: len(lights)]
        pairs = [self._image(place, light, rng) for place, light in zip(chosen.tolist(), lights, strict=True)]
        return [image for image, _ in pairs], np.array([truth for _, truth in pairs])

    def _offsets(self, veil: float) -> Floats:
        weights = self.seen.weights(self.seen.paper.sum(axis=0) / self.seen.paper.sum())
        white = weights @ self.seen.paper
        black = np.tensordot(weights, self.seen.responses[:, 0], 1)
        means = self.images.astype(np.float32).mean(axis=(1, 2)).reshape(-1, 3, 3)
        colours = np.tensordot(means, weights, ((1,), (0,)))
        return _offset((colours - veil * black) / (1 - veil * black / white) / white)

    def _image(self, place: int, light: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        if self.rendering == "naive":
            return (self.images[place].astype(np.float32) * (light / light.max())).astype(
                np.float32
            ), light / light.sum()
        weights = self.seen.weights(light)
        white = weights @ self.seen.paper
        black = np.tensordot(weights, self.seen.responses[:, 0], 1)
        parts = self.images[place].astype(np.float32).reshape(SMALL, SMALL, 3, 3)
        image = np.tensordot(parts, weights.astype(np.float32), ((2,), (0,)))
        share = {"keep": 0, "codes": 0, "compensate": VEIL, "random": rng.uniform(0, VEIL)}[self.rendering]
        image = np.maximum((image - share * black) / (1 - share * black / white), 0) / white.max()
        return np.ascontiguousarray(image, dtype=np.float32), white / white.sum()


def features_of(learner: FeatureLearner, images: Sequence[Floats], masked: bool) -> Floats:
    """Return the features of images, pixels that are wholly zero left out where they are masks."""
    found: list[Any] = [learner.features(image, None, (image == 0).all(axis=2) if masked else None) for image in images]
    return np.stack(found)


def main() -> None:
    """Print the pooled ratios of each lever."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, action="append", required=True, help="folder; may be repeated")
    parser.add_argument("--archives", type=Path, required=True, help="folder of the three files in CAMERAS")
    parser.add_argument("--lever", action="append", required=True)
    parser.add_argument("--learners", default="regression-trees,kernel-ridge,log-chroma")
    parser.add_argument("--cameras", default=",".join(CAMERAS))
    parser.add_argument("--images", type=int, default=900)
    parser.add_argument("--seeds", type=int, default=1, help="of learners, folds and training images: 0, 1, …")
    given = parser.parse_args()
    cameras = given.cameras.split(",")
    learners = {key: standard_learners()[key] for key in given.learners.split(",")}
    seeds = range(given.seeds)
    pictures = read_pictures(given.pictures)
    real = {name: read_real(given.archives, name) for name in CAMERAS}
    prints = {name: Print(name) for name in cameras}
    known = {(c, k): features_of(one, list(real[c].images), True) for c in cameras for k, one in learners.items()}
    places = {key: np.zeros((given.seeds, len(real[key[0]].lights))) for key in known}
    errors: dict[str, dict[tuple[str, str], Floats]] = {"real": places}
    for (camera, key), seed in itertools.product(known, seeds):
        lights = real[camera].lights
        fold = np.random.default_rng(seed).permutation(len(lights)) % 3
        for number in range(3):
            held = fold == number
            model = learners[key].fit_features(known[camera, key][~held], lights[~held], seed)
            found = recovery_error(model.lights(known[camera, key][held]), lights[held])
            errors["real"][camera, key][seed, held] = found
    for lever in given.lever:
        errors[lever] = {place: np.zeros_like(found) for place, found in errors["real"].items()}
        for camera in cameras:
            others = [some for name, some in real.items() if name != camera]
            training = Training(lever, pictures, prints[camera], real[camera], others)
            halves = real[camera].halves()
            for half, seed in itertools.product((0, 1), seeds):
                rng = np.random.default_rng(1000 * seed + half)
                other, test = halves[1 - half], halves[half]
                turns = given.images // len(other) + 1
                under = np.concatenate([rng.permutation(len(other)) for _ in range(turns)])[: given.images]
                images, truths = training.make(real[camera].lights[other][under], other, rng)
                for key, learner in learners.items():
                    made = features_of(learner, images, lever == "relit")
                    model = learner.fit_features(made, truths, seed)
                    found = recovery_error(model.lights(known[camera, key][test]), real[camera].lights[test])
                    errors[lever][camera, key][seed, test] = found
        _tell(errors, lever, cameras, list(learners))


def ratios_of(one: Floats, other: Floats) -> list[tuple[float, float, float]]:
    """Return the ratio of each statistic of errors (seeds, N), a mean over the seeds, with its interval.

    A resample is of images, and one that is drawn counts in every seed, as `evaluate transfer` has it.
    """
    samples = [[ErrorSample.of(errors) for errors in several] for several in (one, other)]

    def ratios(counts: npt.NDArray[np.int64]) -> Floats:
        known = [np.mean([sample.statistics(counts) for sample in several], axis=0) for several in samples]
        return safe_ratio(*known)

    return list(bounded_figures(ratios, one.shape[1]))


def _tell(
    errors: dict[str, dict[tuple[str, str], Floats]], lever: str, cameras: list[str], learners: list[str]
) -> None:
    for base in (name for name in ("real", "naive-matrix") if name in errors and name != lever):
        for key in learners:
            pair = [np.concatenate([errors[name][camera, key] for camera in cameras], axis=1) for name in (lever, base)]
            ratios = dict(zip(STATISTICS, ratios_of(*pair), strict=True))
            told = [f"{name} {ratios[name][0]:.2f} ({ratios[name][1]:.2f} – {ratios[name][2]:.2f})" for name in _SHOWN]
            each: list[str] = []
            for camera in cameras:
                alone = dict(
                    zip(STATISTICS, ratios_of(errors[lever][camera, key], errors[base][camera, key]), strict=True)
                )
                each.append(f"{camera} {alone['median'][0]:.2f}/{alone['mean'][0]:.2f}")
            medians = np.median(pair[0], axis=1) / np.median(pair[1], axis=1)
            spread = f"; medians by seed {medians.min():.2f} … {medians.max():.2f}" if len(medians) > 1 else ""
            print(f"{lever} against {base}, {key}: {', '.join(told)}; {', '.join(each)}{spread}", flush=True)


_SHOWN: tuple[Statistic, ...] = ("median", "mean", "worst25")

if __name__ == "__main__":
    main()
