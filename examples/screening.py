r"""Compare variants of rendering on three real cameras in minutes, without LUTs on disk: a fast version of worth.sh.

The camera response to each patch of the simulated print is computed for the three primaries of the projector. An
illuminant of a given chromaticity is a mixture of these primaries. A pixel of a thumbnail is the mean of several
patches, so there is no dithering noise and no sensor noise.

Everything else is as in the commands. Illuminants come from the half of the camera's images that is not tested. The
learned methods are those of `evaluate`. They are compared with cross-validation on all real images of the camera.
Ratios of errors are pooled over the cameras and averaged over the seeds, with bootstrap intervals over the images.

    python examples/screening.py --pictures BSDS500/data/images --pictures imagenet-sample-images \
        --archives ARCHIVES --lever naive-matrix --lever random-like

ARCHIVES is the folder with the thumbnails of the three cameras, as in examples/worth.sh.

A lever is a variant of the training images:

- naive, naive-matrix: without a print, as in `evaluate transfer --naive`;
- codes: rendering by codes;
- keep, compensate, random: rendering by colour under the projector's white, with this treatment of the print's black;
- relit: real scenes of the other cameras under other illuminants.

The suffix -neutral, as in keep-neutral, selects the 75 % of the pictures with the most neutral mean. The suffix
-like draws pictures so that their grey-world offsets (mean colour relative to the illuminant) are distributed like the
offsets of the real images.
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

# Archive, sensitivities, colour matrix, and a text contained in the names of its images.
CAMERAS = {
    "600D": ("nus_canon_600d_64x64.npz", "Canon_EOS_600D", "Canon EOS 600D", "Canon"),
    "1Ds Mark III": ("nus_canon_1ds_mk3_64x64.npz", "Canon_EOS-1Ds_Mark_III", "Canon EOS-1Ds Mark III", "Canon"),
    "5DSR": ("intel_tau_5dsr_64x64.npz", "Canon_EOS_5DS", "Canon EOS 5DS R", "field"),
}

LINEAR = decode_srgb(np.arange(256) / 255)
WIDTH = 32
CODES = np.rint(np.arange(WIDTH) * 255 / (WIDTH - 1)).astype(np.int64)
SIDE, SMALL = 128, 64  # side of pictures and of training images, px
TARGET_WHITE = 0.97  # white of the target colours, relative to paper
MAX_BLACK = 0.97  # largest share of the print's black that is subtracted


@dataclass(frozen=True, eq=False)
class Real:
    """Real images of a camera, (N, 64, 64, 3) float32, and their illuminants (N, 3), sum 1."""

    images: Floats
    lights: Floats

    def halves(self) -> tuple[Floats, Floats]:
        """Return the indices of two halves, drawn with seed 0."""
        order = np.random.default_rng(0).permutation(len(self.lights))
        middle = len(order) // 2
        return np.sort(order[:middle]), np.sort(order[middle:])

    def offsets(self) -> Floats:
        """Return the grey-world offsets (N, 2): ln R/G and ln B/G of mean / illuminant."""
        return np.array(
            [_offset(x[x.max(2) > 0].mean(0) / light) for x, light in zip(self.images, self.lights, strict=True)]
        )


def read_real(folder: Path, name: str) -> Real:
    """Read the archive of a camera."""
    archive, _, _, name_part = CAMERAS[name]
    with np.load(folder / archive) as content:
        is_selected = np.array([name_part in name for name in content["names"].tolist()])
        images, lights = (
            content["images"][is_selected].astype(np.float32),
            content["gt"][is_selected].astype(np.float64),
        )
    return Real(images / images.max(axis=(1, 2, 3), keepdims=True), lights / lights.sum(axis=1, keepdims=True))


def read_pictures(folders: Sequence[Path]) -> Floats:
    """Read the pictures of folders, (N, 128, 128, 3) uint8, squeezed to squares like the real thumbnails."""
    files = [path for folder in folders for path in sorted(folder.rglob("*"))]
    pictures: list[Any] = []
    for path in files:
        picture = cv2.imread(str(path)) if path.suffix.lower() in (".jpg", ".jpeg", ".png") else None
        if picture is not None:
            square = cv2.resize(picture[..., ::-1], (160, 160), interpolation=cv2.INTER_AREA)
            pictures.append(cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_AREA))
    return np.array(pictures)


def _offset(colour: Floats) -> Floats:
    return np.log(colour[..., [0, 2]] / colour[..., 1:2])


def _halved(pixels: Floats) -> Floats:
    return pixels.reshape(SMALL, 2, SMALL, 2, -1).mean(axis=(1, 3))


class Print:
    """Responses of a camera to the simulated print under the projector's primaries."""

    def __init__(self, name: str) -> None:
        sensitivities = read_sensitivities(CAMERAS[name][1]).at(np.arange(380.0, 781.0, 5.0))
        red, green, blue = np.meshgrid(CODES, CODES, CODES, indexing="ij")
        self.codes: Floats = np.stack([red.ravel(), green.ravel(), blue.ravel()], axis=1)
        responses: Floats = np.einsum(
            "pl,nl,lc->pnc", projector_primaries(), print_reflectance(self.codes), sensitivities, optimize=True
        )
        self.responses: Floats = responses / responses[:, -1].sum(axis=0)[1]
        self.paper: Floats = self.responses[:, -1]
        matrix = camera_matrix(CAMERAS[name][2])
        if matrix is None:
            raise ValueError(name)
        self.matrix: Floats = matrix.rows

    def weights(self, light: Floats) -> Floats:
        """Return the weights (3,) of the primaries that give paper this chromaticity, clipped at 0."""
        solve: Any = np.linalg.solve
        return np.maximum(solve(self.paper.T, light / light[1]), 0)

    def node_responses(self, colorimetric: bool) -> Floats:
        """Return the mean responses (32768, 9) float32 to each source colour (node); the 9 are primaries × channels."""
        if not colorimetric:
            return self.responses.transpose(1, 0, 2).reshape(-1, 9).astype(np.float32)
        white = self.paper.sum(axis=0)
        relative = np.tensordot(self.weights(white / white.sum()), self.responses, 1)
        relative = relative / relative[-1]
        black = relative[0].mean()
        target = black + (TARGET_WHITE - black) * np.clip(np.maximum(LINEAR[self.codes] @ self.matrix.T, 0), 0, 1)
        mesh: Any = Delaunay(relative)
        simplex = mesh.find_simplex(target)
        transforms = mesh.transform[simplex]
        shares = np.einsum("kij,kj->ki", transforms[:, :3], target - transforms[:, 3])
        weights = np.concatenate([shares, 1 - shares.sum(axis=1, keepdims=True)], axis=1)
        cells = mesh.simplices[simplex].copy()
        outside = simplex < 0
        if outside.any():
            nearest: Any = cKDTree(np.cbrt(relative)).query(np.cbrt(target[outside]))
            cells[outside], weights[outside] = nearest[1][:, None], 0.25
        weights = np.clip(weights, 0, None)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.einsum("kj,pkjc->kpc", weights, self.responses[:, cells]).reshape(-1, 9).astype(np.float32)


def nodes_of(picture: Floats, rng: np.random.Generator, linear: bool) -> Floats:
    """Return a random node for each pixel (H, W) of a picture (H, W, 3) uint8; the mean colour is preserved."""
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

    def __init__(self, lever: str, pictures: Floats, camera_print: Print, real: Real, others: Sequence[Real]) -> None:
        self.rendering, _, self.suffix = lever.partition("-")
        self.camera_print, self.real, self.others = camera_print, real, others
        rng, made = np.random.default_rng(0), []
        if self.rendering == "naive":
            matrix = camera_print.matrix if self.suffix == "matrix" else np.eye(3)
            linear = [np.maximum(LINEAR[picture] @ matrix.T, 0) for picture in pictures]
            made = [_halved(image) for image in linear]
        elif self.rendering != "relit":
            dithered = self.rendering != "codes"
            responses = camera_print.node_responses(dithered)
            made = [_halved(responses[nodes_of(picture, rng, dithered)]) for picture in pictures]
        # Relit images are made at each call.
        self.images: Floats = np.array(made).astype(np.float16)

    def make(self, lights: Floats, training_half: Floats, rng: np.random.Generator) -> tuple[list[Floats], Floats]:
        """Return an image and its ground truth for each illuminant (N, 3); `training_half` holds indices."""
        if self.rendering == "relit":
            scenes = [x / light for some in self.others for x, light in zip(some.images, some.lights, strict=True)]
            order = np.concatenate([rng.permutation(len(scenes)) for _ in range(len(lights) // len(scenes) + 1)])
            relit = [scenes[number] * light for number, light in zip(order, lights, strict=False)]
            return [(image / image.max()).astype(np.float32) for image in relit], lights
        count = len(self.images)
        if self.suffix == "like":
            own, target = (self._offsets(0.5 if self.rendering == "random" else 0), self.real.offsets()[training_half])
            density: Any = gaussian_kde(target.T)(own.T) / np.maximum(gaussian_kde(own.T)(own.T), 1e-3)
            density = np.minimum(density, np.quantile(density, 0.98))
            chosen = rng.choice(count, len(lights), p=density / density.sum())
        else:
            pool = np.arange(count)
            if self.suffix == "neutral":
                pool = np.argsort(np.hypot(*self._offsets(MAX_BLACK).T))[: count * 3 // 4]
            chosen = np.concatenate([rng.permutation(pool) for _ in range(len(lights) // len(pool) + 1)])[: len(lights)]
        pairs = [self._image(number, light, rng) for number, light in zip(chosen.tolist(), lights, strict=True)]
        return [image for image, _ in pairs], np.array([truth for _, truth in pairs])

    def _offsets(self, black_share: float) -> Floats:
        weights = self.camera_print.weights(self.camera_print.paper.sum(axis=0) / self.camera_print.paper.sum())
        white = weights @ self.camera_print.paper
        black = np.tensordot(weights, self.camera_print.responses[:, 0], 1)
        means = self.images.astype(np.float32).mean(axis=(1, 2)).reshape(-1, 3, 3)
        colours = np.tensordot(means, weights, ((1,), (0,)))
        return _offset((colours - black_share * black) / (1 - black_share * black / white) / white)

    def _image(self, number: int, light: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        if self.rendering == "naive":
            return (self.images[number].astype(np.float32) * (light / light.max())).astype(
                np.float32
            ), light / light.sum()
        weights = self.camera_print.weights(light)
        white = weights @ self.camera_print.paper
        black = np.tensordot(weights, self.camera_print.responses[:, 0], 1)
        parts = self.images[number].astype(np.float32).reshape(SMALL, SMALL, 3, 3)
        image = np.tensordot(parts, weights.astype(np.float32), ((2,), (0,)))
        share = {"keep": 0, "codes": 0, "compensate": MAX_BLACK, "random": rng.uniform(0, MAX_BLACK)}[self.rendering]
        image = np.maximum((image - share * black) / (1 - share * black / white), 0) / white.max()
        return np.ascontiguousarray(image, dtype=np.float32), white / white.sum()


def features_of(learner: FeatureLearner, images: Sequence[Floats], masked: bool) -> Floats:
    """Return the features of images; if `masked`, pixels with the value zero are excluded."""
    rows: list[Any] = [learner.features(image, None, (image == 0).all(axis=2) if masked else None) for image in images]
    return np.stack(rows)


def main() -> None:
    """Print the pooled ratios of each lever."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, action="append", required=True, help="folder; may be repeated")
    parser.add_argument("--archives", type=Path, required=True, help="folder of the three files in CAMERAS")
    parser.add_argument("--lever", action="append", required=True)
    parser.add_argument("--learners", default="regression-trees,kernel-ridge,log-chroma")
    parser.add_argument("--cameras", default=",".join(CAMERAS))
    parser.add_argument("--images", type=int, default=900)
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds of learners, folds and training images")
    options = parser.parse_args()
    cameras = options.cameras.split(",")
    learners = {key: standard_learners()[key] for key in options.learners.split(",")}
    seeds = range(options.seeds)
    pictures = read_pictures(options.pictures)
    real = {name: read_real(options.archives, name) for name in CAMERAS}
    prints = {name: Print(name) for name in cameras}
    inputs = {
        (c, k): features_of(learner, list(real[c].images), True) for c in cameras for k, learner in learners.items()
    }
    real_errors = {key: np.zeros((options.seeds, len(real[key[0]].lights))) for key in inputs}
    errors: dict[str, dict[tuple[str, str], Floats]] = {"real": real_errors}
    for (camera, key), seed in itertools.product(inputs, seeds):
        lights = real[camera].lights
        fold = np.random.default_rng(seed).permutation(len(lights)) % 3
        for number in range(3):
            tested = fold == number
            model = learners[key].fit_features(inputs[camera, key][~tested], lights[~tested], seed)
            test_errors = recovery_error(model.lights(inputs[camera, key][tested]), lights[tested])
            errors["real"][camera, key][seed, tested] = test_errors
    for lever in options.lever:
        errors[lever] = {pair: np.zeros_like(test_errors) for pair, test_errors in errors["real"].items()}
        for camera in cameras:
            others = [others for name, others in real.items() if name != camera]
            training = Training(lever, pictures, prints[camera], real[camera], others)
            halves = real[camera].halves()
            for half, seed in itertools.product((0, 1), seeds):
                rng = np.random.default_rng(1000 * seed + half)
                other, test = halves[1 - half], halves[half]
                repeats = options.images // len(other) + 1
                order = np.concatenate([rng.permutation(len(other)) for _ in range(repeats)])[: options.images]
                images, truths = training.make(real[camera].lights[other][order], other, rng)
                for key, learner in learners.items():
                    train_features = features_of(learner, images, lever == "relit")
                    model = learner.fit_features(train_features, truths, seed)
                    test_errors = recovery_error(model.lights(inputs[camera, key][test]), real[camera].lights[test])
                    errors[lever][camera, key][seed, test] = test_errors
        _print_ratios(errors, lever, cameras, list(learners))


def ratios_of(first: Floats, second: Floats) -> list[tuple[float, float, float]]:
    """Return the ratio of each statistic of errors (seeds, N), averaged over the seeds, with its interval.

    The bootstrap draws images; a drawn image counts with its errors of all seeds, as in `evaluate transfer`.
    """
    samples = [[ErrorSample.of(errors) for errors in by_seed] for by_seed in (first, second)]

    def ratios(counts: npt.NDArray[np.int64]) -> Floats:
        means = [np.mean([sample.statistics(counts) for sample in by_seed], axis=0) for by_seed in samples]
        return safe_ratio(*means)

    return list(bounded_figures(ratios, first.shape[1]))


def _print_ratios(
    errors: dict[str, dict[tuple[str, str], Floats]], lever: str, cameras: list[str], learners: list[str]
) -> None:
    for base in (name for name in ("real", "naive-matrix") if name in errors and name != lever):
        for key in learners:
            pair = [np.concatenate([errors[name][camera, key] for camera in cameras], axis=1) for name in (lever, base)]
            ratios = dict(zip(STATISTICS, ratios_of(*pair), strict=True))
            texts = [f"{name} {ratios[name][0]:.2f} ({ratios[name][1]:.2f} – {ratios[name][2]:.2f})" for name in _SHOWN]
            by_camera: list[str] = []
            for camera in cameras:
                camera_ratios = dict(
                    zip(STATISTICS, ratios_of(errors[lever][camera, key], errors[base][camera, key]), strict=True)
                )
                by_camera.append(f"{camera} {camera_ratios['median'][0]:.2f}/{camera_ratios['mean'][0]:.2f}")
            medians = np.median(pair[0], axis=1) / np.median(pair[1], axis=1)
            range_text = f"; medians by seed {medians.min():.2f} … {medians.max():.2f}" if len(medians) > 1 else ""
            print(f"{lever} against {base}, {key}: {', '.join(texts)}; {', '.join(by_camera)}{range_text}", flush=True)


_SHOWN: tuple[Statistic, ...] = ("median", "mean", "worst25")

if __name__ == "__main__":
    main()
