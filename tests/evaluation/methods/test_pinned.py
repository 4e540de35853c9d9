"""What every method gives of a few small images, to the last digits: no change of the code may move them unseen."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.cross_validation import settings_of
from evaluation.methods import gray_pixels, pixel_loops, prepared
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.gray_pixels import GraynessIndex, LocalGraynessIndex, MeanShiftedGrayPixel, largest_cluster
from evaluation.methods.green_stability import tune
from evaluation.methods.method import LocalMethod, Method
from evaluation.methods.pca import BrightDark
from evaluation.methods.prepared import PreparedImage
from evaluation.methods.retinex import ColorSparrow, ImprovedWhitePatch, SurfaceReflectance
from evaluation.methods.standard import local_methods, standard_methods
from evaluation.methods.wrapped import PatchwiseMethod, ResizedMethod, fill_unknown
from tests.evaluation.made_up import Wall
from tests.pinned import Pinned

# Parts of a method are pinned as well, since its estimate may not show them.

pytestmark = pytest.mark.slow

Image = npt.NDArray[Any]
Given = tuple[Image, float | None, npt.NDArray[np.bool_] | None]


def tiles(height: int, width: int, seed: int) -> npt.NDArray[np.float64]:
    """Return coloured tiles with texture (H, W, 3), 20 … 3500, the lower third darker and bluer."""
    random = np.random.default_rng(seed)
    rough = random.uniform(0.1, 1, (height // 7 + 1, width // 9 + 1, 3)).repeat(7, axis=0).repeat(9, axis=1)
    image = 20 + 3000 * rough[:height, :width] * random.uniform(0.6, 1, (height, width, 1)) * [0.5, 1.0, 0.7]
    image[2 * height // 3 :] *= [0.3, 0.5, 0.8]
    return image


def cases() -> dict[str, Given]:
    """Return images of odd sizes in each dtype, some masked, some with clipped pixels that lie at the limit."""
    limit = tiles(37, 53, 2).astype(np.float32)
    limit[5, 7], limit[5, 8], limit[36, 52], limit[20, 30] = 2500, (2499, 90, 90), (9000, 1, 1), (10, 2500, 0)
    masked = tiles(40, 131, 3)
    mask = np.random.default_rng(1).random((40, 131)) < 0.2
    mask[:, 100:] = True
    far = tiles(30, 40, 4) * 2.0**-70
    far[3, 3:9] = 0
    return {
        "whole": (tiles(72, 90, 1).astype(np.uint16), None, None),
        "whole at the limit": (np.minimum(tiles(66, 70, 6), 2200).astype(np.uint16), 2200.0, None),
        "single at the limit": (limit, 2500.0, None),
        "double masked": (masked, 3400.0, mask),
        "tiny values": (far, None, None),
        "five by seven": (tiles(5, 7, 5), None, None),
        "one row": (tiles(1, 9, 6).astype(np.uint16), None, None),
        "one column": (tiles(19, 1, 6).astype(np.float32), 3000.0, None),
    }


def many(seed: int = 8) -> Image:
    """Return so many pixels (300, 311, 3) uint16 that limits are found of some of them, in large groups of equals."""
    image = tiles(300, 311, seed)
    image[:20] = image[0, 0]
    image[140:200] = np.rint(image[140:200] / 500) * 500
    return image.astype(np.uint16)


CASES = cases()

OTHERS: dict[str, Method] = {
    "p 1.5": GrayEdge("", 0, 1.5, 0),
    "p 16": GrayEdge("", 0, 16, 0),
    "p 17": GrayEdge("", 0, 17, 0),
    "p 64": GrayEdge("", 0, 64, 1),
    "p 65": GrayEdge("", 1, 65, 0.5),
    "border 2": GrayEdge("", 0, 3, 0, border=2),
    "border 0": GrayEdge("", 2, 3, 2, border=0),
    "norm of edges": GrayEdge("", 1, np.inf, 1.2),
    "large scale": GrayEdge("", 2, 2, 4.5),
    "pca all": BrightDark(share=0.5),
    "pca a fifth": BrightDark(share=0.2),
    "grayness a twentieth": GraynessIndex(share=0.05),
    "mean shift a fifth": MeanShiftedGrayPixel(share=0.2),
    "sparrow": ColorSparrow(spray=20, step=4, kernel=3, seed=5),
    "white patch": ImprovedWhitePatch(pixels=5, samples=7, seed=2),
    "reflectance": SurfaceReflectance(patches=3),
    "shrunk": ResizedMethod(GrayEdge("", 1, 2, 1), 21),
    "by patches": PatchwiseMethod(GrayEdge("", 0, 2, 0), 3),
}


@pytest.mark.parametrize("case", CASES)
def test_estimates(case: str, pinned: Pinned) -> None:
    image, saturation, mask = CASES[case]
    methods = {**standard_methods(), **OTHERS}
    pinned(
        f"estimates of an image, {case}",
        {name: method.estimate(image, saturation, mask) for name, method in methods.items()},
        same=1e-5,
        nothing=1e-7,
    )


def test_estimates_of_many_pixels(pinned: Pinned) -> None:
    image = many()
    mask = np.zeros(image.shape[:2], bool)
    mask[::3, 50:120] = True
    methods = {
        **{name: standard_methods()[name] for name in ("pca", "gray-edge-1", "general-gray-world", "grayness-index")},
        **{f"pca {share}": BrightDark(share=share) for share in (0.0001, 0.01, 0.1, 0.3, 0.4999)},
        "mean shift": MeanShiftedGrayPixel(share=0.03),
        "local": LocalGraynessIndex(),
    }
    found = {name: [m.estimate(image), m.estimate(image, 2900.0, mask)] for name, m in methods.items()}
    pinned("estimates of many pixels", found, same=1e-5, nothing=1e-7)


def test_maps_of_lights(pinned: Pinned) -> None:
    methods: dict[str, LocalMethod] = {
        **local_methods(),
        "3 patches": PatchwiseMethod(GrayEdge("", 0, 2, 0), 3),
        "1 patch": PatchwiseMethod(GrayEdge("", 0, 1, 0), 1),
        "3 lights": LocalGraynessIndex(share=0.3, lights=3),
        "5 lights": LocalGraynessIndex(share=0.02, lights=5),
    }
    found = {
        case: {name: np.asarray(method.estimate_map(*given)) for name, method in methods.items()}
        for case, given in CASES.items()
    }
    pinned("maps of lights by every local method", found, same=1e-5, nothing=1e-6)
    unknown = tiles(5, 4, 9)
    unknown[0, 1:3] = unknown[2, 2] = unknown[4] = np.nan
    pinned(
        "lights of patches where some are unknown", [fill_unknown(unknown), fill_unknown(np.full((2, 2, 3), np.nan))]
    )


@pytest.mark.parametrize("case", CASES)
def test_what_methods_share_of_an_image(case: str, pinned: Pinned) -> None:
    one = PreparedImage(*CASES[case])
    found = {
        "peak, scale, white": (one.peak, one.scale / 2.0**60, one.white),
        "usable": {border: np.asarray(one.usable(border)) for border in (0, 3)},
        "moments": {border: one.moments(border) / 2.0 ** (border % 2) for border in (0, 1, 2, 5)},
        "norms": {f"{p} {border}": one.norm(0, 0, p, border) for p in (1, 1.5, 3, 20, np.inf) for border in (0, 2)},
        "derivatives": {
            f"{order} {sigma}": np.asarray(one.derivative(order, sigma))
            for order in (0, 1, 2)
            for sigma in (0.3, 1.0, 4.6)
            if order or sigma
        },
        "smaller": [
            [small.image.shape, np.asarray(small.image), np.asarray(small.usable(0))]
            for small in map(one.at_most, (4, 20, 64))
        ],
        "shrunk": [np.asarray(prepared.shrink(one.image, one.usable(1), 5, least)[0]) for least in (0.0, 0.3, 0.75)],
    }
    pinned(f"shared parts of an image, {case}", found, same=1e-5, nothing=0 if case == "tiny values" else 1e-6)


def test_parts_of_gray_pixels(pinned: Pinned) -> None:
    strip = (tiles(24, 31, 11) / 3500).astype(np.float32)
    strip[:9, :9] = 0.25
    strip[0, 20:], strip[12:, 14:22, 1], strip[5, 15] = 8 / 255 / 3, 0, 0
    one = PreparedImage(strip, None, None)
    places = np.argwhere(strip[..., 0] > 0.2).astype(np.float64)
    cluster = strip[8:16, 8:14].reshape(-1, 3).astype(np.float64)
    cluster /= cluster.max()
    angle, missing = gray_pixels.angle_to_grey(strip)
    mapped = gray_pixels.index_map(one, gray_pixels.angle_to_grey)
    found = {
        "slope": gray_pixels.slope(strip),
        "slope of one channel": gray_pixels.slope(strip[..., 0]),
        "smooth": gray_pixels.smooth(strip),
        "logarithm": gray_pixels.logarithm(strip),
        "grayness": gray_pixels.grayness(strip),
        # Of flat pixels it is what rounding leaves.
        "angle": [np.where(missing, 0, angle), missing],
        "maps": [gray_pixels.index_map(one, gray_pixels.grayness), *mapped],
        "clusters": [gray_pixels._clusters(places, count) for count in (1, 2, 3, 7)],
        "largest": largest_cluster(cluster, np.arange(len(cluster), dtype=np.float32)),
        "steps": [gray_pixels._step(cluster[at], cluster[at + 3]) for at in (0, 5, 20)],
        "shifts": [
            gray_pixels._shift(cluster, cluster / np.linalg.norm(cluster, axis=1, keepdims=True), at)
            for at in (0, 9, 30)
        ],
        "greyest": [
            int(gray_pixels.greyest(strip[..., 2], strip[..., 0] > 0.1, share).sum())
            for share in (0.0, 0.001, 0.01, 0.3, 1.0)
        ],
    }
    pinned("parts of methods of gray pixels", found, same=1e-4, nothing=1e-6)


def test_loops_over_pixels(pinned: Pinned) -> None:
    image = np.ascontiguousarray(many(3)[:40, :140])
    single = np.ascontiguousarray(many(4)[:40, :140].astype(np.float32) / 4096)
    free = np.random.default_rng(0).random(image.shape[:2]) < 0.9
    free[:, 20:100] = True
    every: npt.NDArray[np.bool_] = np.zeros((0, 0), bool)
    direction = np.array([0.3, 0.8, 0.5])
    found: dict[str, Any] = {}
    for name, usable in (("every", every), ("free", free)):
        powers = {}
        for p in (1.0, 2.0, 2.5, 3.0, 7.0, 64.0, 65.0, np.inf):
            for border, top, first in ((0, 0, 0), (3, 2, 16), (1, 10, 5)):
                sums = np.zeros(3)
                rows = single[top:, first:].reshape(len(single) - top, -1)
                pixel_loops.sum_powers(rows, usable, border, top, first, 38, 137, p, 0.9, sums)
                powers[f"{p} {border} {top} {first}"] = sums
        step = pixel_loops.BINS / float(direction @ image.reshape(-1, 3).max(axis=0))
        counts = [pixel_loops.count_projections(image, usable, direction, step, every_) for every_ in (1, 2, 16)]
        bordering = np.zeros((900, 4))
        outer = pixel_loops.sum_outer_bins(
            image, usable, direction, step, np.array([300, 900, 1800, 2400], np.int64), bordering
        )
        found[name] = [powers, counts, outer, bordering, pixel_loops.whole_moments(image, usable, 2)]
        found[name].append(pixel_loops.float_moments(single, usable, 1, 0.5))
    clipped = np.zeros(image.shape[:2], np.uint8)
    found["clipped"] = [pixel_loops.mark_clipped(image, image.dtype.type(2000), clipped), clipped]
    found["dilated"] = [prepared.dilate_clipped(given, limit) for given in (image, single) for limit in (0.5, 2000.0)]
    pinned("loops over pixels", found, same=1e-5)


def test_tuning_and_names(pinned: Pinned) -> None:
    scenes = [Wall(str(at), np.array([0.3 + 0.1 * at, 0.5, 0.9 - 0.1 * at]), seed=at) for at in range(4)]
    images = [tiles(24, 32, at) * scene.truth for at, scene in enumerate(scenes)]

    class Tiles(Wall):
        def read(self) -> Any:
            return images[int(self.name)].astype(np.float32), None

    given = [Tiles(scene.name, scene.truth) for scene in scenes]
    families = {name: [method for _, method in settings_of(name)] for name in ("shades-of-gray", "gray-edge-1")}
    found = {name: vars(tune(methods, given)) for name, methods in families.items()}
    for one in found.values():
        one["best"], one["candidates"] = one["best"].name, [method.name for method in one["candidates"]]
    pinned("tuning by green stability", found, same=1e-5)
