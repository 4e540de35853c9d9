"""Influence of colour reduction on estimates (section 4.2 of the paper).

The tone mapping operator Flash converts real linear images to 8-bit codes. The lowest n bits of each code are set to
zero. The inverse of Flash then gives linear images for the methods. If n is 0, the codes are only rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.running import require_truths
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Method
from evaluation.methods.prepared import usable
from evaluation.methods.standard import standard_methods
from evaluation.metrics import ErrorKind
from evaluation.results.result import Result, SceneAnswer, collect_results, read_estimate
from evaluation.results.tables import ERROR_COLUMNS, Table
from evaluation.scene import Image, Scene, report_progress
from foundation.compiled import ordered_map
from generator.files import Flash, fit_flash
from generator.pictures.sources import clear_bits

BITS: Final = tuple(range(8))  # Numbers of bits set to zero, as in the figure of the paper

GRAY_EDGE_SIGMA: Final = 6.0  # Scale of Gray-Edge in the NUS tables, px, for images of full size


def reduce_colours(
    image: Image, bits: int | Sequence[int], mask: npt.NDArray[np.bool_] | None = None
) -> list[npt.NDArray[np.float32]]:
    """Return a linear image for each number in `bits`, after this number of bits of its codes was set to zero.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, any unit. `bits`: one or several numbers.
    `mask`: (H, W) bool, True for pixels to which Flash is not fitted. The images are (H, W, 3) float32, relative to the
    largest unmasked value.

    Examples
    --------
    >>> wall = np.array([[[500.0, 1000.0, 700.0], [20.0, 30.0, 10.0]]])
    >>> raw, coarse = reduce_colours(wall, (0, 6))
    >>> raw.round(3)
    array([[[0.5  , 1.   , 0.701],
            [0.02 , 0.03 , 0.01 ]]], dtype=float32)
    >>> coarse.round(3)
    array([[[0.143, 0.349, 0.349],
            [0.   , 0.023, 0.   ]]], dtype=float32)
    """
    counts = (bits,) if isinstance(bits, int) else tuple(bits)
    fitted = fit_codes(image, mask)
    return [fitted.operator.invert(clear_bits(fitted.codes, count)).astype(np.float32) for count in counts]


@dataclass(frozen=True, eq=False)
class FittedCodes:
    """Codes of a linear image, calculated by Flash."""

    codes: npt.NDArray[np.uint8]  # (H, W, 3) uint8
    operator: Flash  # The fitted operator, for values relative to `largest`
    largest: float  # Largest unmasked value, in the unit of the image; 0 for a black image


def fit_codes(image: Image, mask: npt.NDArray[np.bool_] | None = None) -> FittedCodes:
    """Fit Flash to a linear image, and return its 8-bit codes.

    `image`, `mask`: as in `reduce_colours`.
    """
    # The parameters k and scale of Flash are fitted to the image, see `generator.files`.
    values = np.asarray(image, dtype=np.float64)
    unmasked = values.reshape(-1, 3) if mask is None else values[~mask]
    largest = float(unmasked.max(initial=0.0))
    if not largest:
        return FittedCodes(np.zeros(values.shape, np.uint8), Flash(1.0, 255.0, 1.0), 0.0)
    operator = fit_flash(unmasked / largest)
    codes = np.clip(np.rint(operator.apply(values / largest)), 0, 255).astype(np.uint8)
    return FittedCodes(codes, operator, largest)


def paper_methods(sigma: float = GRAY_EDGE_SIGMA) -> tuple[Method, ...]:
    """Return the methods of the paper's figure; `sigma` is the scale of Gray-Edge, px."""
    methods = standard_methods()
    gray_edge = (
        methods["gray-edge-1"]
        if sigma == GRAY_EDGE_SIGMA
        else GrayEdge(f"1st-order Gray-Edge (σ={sigma:g})", 1, 1, sigma)
    )
    return (methods["gray-world"], methods["shades-of-gray"], gray_edge)


@dataclass(frozen=True, eq=False)
class BitsResult:
    """Results of methods on unchanged images, and on images with bits set to zero."""

    raw: tuple[Result, ...]  # Results on the unchanged images, one for each method
    reduced: Mapping[int, tuple[Result, ...]]  # Results of the methods, by number of bits set to zero


def remove_bits(
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    bits: Sequence[int] = BITS,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> BitsResult:
    """Return the results of methods on images with bits set to zero; each image is read once."""
    truths = require_truths(scenes, methods)

    def answers_for(scene: Scene) -> list[list[SceneAnswer]]:
        image, mask = scene.read()
        # Clipped pixels must be found before the reduction. Flash is fitted to all unmasked pixels, as in a camera.
        excluded = ~usable(image, scene.saturation, mask)
        versions: list[Image] = [image, *reduce_colours(image, bits, mask)]
        return [[read_estimate(method.estimate(version, None, excluded)) for method in methods] for version in versions]

    answers = list(report_progress(ordered_map(answers_for, scenes, workers), on_scene))
    names = [method.name for method in methods]
    raw, *reduced = (
        collect_results(names, truths, [item[version] for item in answers]) for version in range(1 + len(bits))
    )
    return BitsResult(raw, dict(zip(bits, reduced, strict=True)))


def bits_table(bits_result: BitsResult, metric: ErrorKind, name: str) -> Table:
    """Return the six statistics of every method for the unchanged images and each number of bits."""
    versions = {"as it is": bits_result.raw, **{str(count): results for count, results in bits_result.reduced.items()}}
    return Table(
        f"{name}: {metric} angular error after bits of the codes made by Flash were set to zero, degrees",
        ("Algorithm", "Bits set to zero", *ERROR_COLUMNS[1:]),
        tuple(
            (results[index].method, label, *results[index].summary(metric).as_tuple())
            for index in range(len(bits_result.raw))
            for label, results in versions.items()
        ),
        notes=("0 bits: only rounded to 8-bit codes.",),
    )


# Longest side of a panel, px: one copy of a picture in `reduction_strip`. Eight panels fit a page.
PANEL: Final = 200

_GAP: Final = 6  # White gap between panels, px

_PANELS_IN_ROW: Final = 4  # Panels in a row


def reduction_strip(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> npt.NDArray[np.uint8]:
    """Return an image (h, w, 3) uint8, sRGB codes: a copy of a picture for each number of bits set to zero.

    `picture`: (H, W, 3) uint8, sRGB codes; it is reduced if a side is longer than `PANEL`. Four copies are in a row.
    """
    import cv2

    scale = min(1.0, PANEL / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    width, height = size
    rows = -(-len(bits) // _PANELS_IN_ROW)
    columns = min(_PANELS_IN_ROW, len(bits))
    shape = (rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3)
    strip = np.full(shape, 255, np.uint8)
    for index, count in enumerate(bits):
        y, x = index // _PANELS_IN_ROW * (height + _GAP), index % _PANELS_IN_ROW * (width + _GAP)
        strip[y : y + height, x : x + width] = clear_bits(small, count)
    return strip


def reduction_table(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> Table:
    """Return number of colours and peak signal-to-noise ratio of a picture (H, W, 3) uint8 after each reduction."""
    rows: list[tuple[str | float | None, ...]] = []
    for count in bits:
        reduced = clear_bits(picture, count)
        colours = len(np.unique(reduced.reshape(-1, 3), axis=0))
        error = float(np.mean((reduced.astype(np.float64) - picture) ** 2))
        ratio = 10 * float(np.log10(255**2 / error)) if error else None
        rows.append((count, 8 ** (8 - count), colours, ratio))
    return Table(
        "A picture with its colours reduced",
        ("Bits set to zero", "Colours possible", "Colours in the picture", "Peak signal to noise, dB"),
        tuple(rows),
        digits=1,
    )
