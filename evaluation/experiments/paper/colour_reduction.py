"""Influence of colour reduction: linear images after bits of their sRGB codes were set to zero (section 4.2).

Real linear images are tone mapped by Flash to codes of 8 bits, the lowest n bits of each code are set to zero, and the
reversed operator takes them back to linear; then methods estimate their lights. Flash's k and scale are those of the
image before (`generator.files`), so that with n = 0 only the rounding to whole codes is left. Masked pixels
have no say in k and scale.
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
from evaluation.results.tables import PAPER_COLUMNS, Table
from evaluation.scene import Image, Scene, report_progress
from foundation.compiled import ordered_map
from generator.files import Flash, fit_flash
from generator.pictures.sources import clear_bits

BITS: Final = tuple(range(8))  # Numbers of bits set to zero, as in the paper's figure

GRAY_EDGE_SIGMA: Final = 6.0  # Scale of Gray-Edge, px: that of its entry in the NUS tables, for images of full size


def reduce_colours(
    image: Image, bits: int | Sequence[int], mask: npt.NDArray[np.bool_] | None = None
) -> list[npt.NDArray[np.float32]]:
    """Return a linear image after `bits` bits of its tone-mapped codes were set to zero, for each of these numbers.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, any unit. `mask`: (H, W) bool, True where a
    pixel has no say in the operator. Returns for each number (H, W, 3) float32, in units of the image's largest
    unmasked value.

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
    found = fitted_codes(image, mask)
    return [found.operator.invert(clear_bits(found.codes, count)).astype(np.float32) for count in counts]


@dataclass(frozen=True, eq=False)
class FittedCodes:
    """A linear image after Flash.

    - `codes`: (H, W, 3) uint8.
    - `operator`: that made them, of values relative to `largest`.
    - `largest`: largest value that is not masked, in the image's unit; 0 of a black image.
    """

    codes: npt.NDArray[np.uint8]
    operator: Flash
    largest: float


def fitted_codes(image: Image, mask: npt.NDArray[np.bool_] | None = None) -> FittedCodes:
    """Return the codes of 8 bits of a linear image, by the operator that is fitted to it.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, any unit. `mask`: (H, W) bool, True where a
    pixel has no say in the operator.
    """
    values = np.asarray(image, dtype=np.float64)
    seen = values.reshape(-1, 3) if mask is None else values[~mask]
    largest = float(seen.max(initial=0.0))
    if not largest:
        return FittedCodes(np.zeros(values.shape, np.uint8), Flash(1.0, 255.0, 1.0), 0.0)
    operator = fit_flash(seen / largest)
    codes = np.clip(np.rint(operator.apply(values / largest)), 0, 255).astype(np.uint8)
    return FittedCodes(codes, operator, largest)


def bits_methods(sigma: float = GRAY_EDGE_SIGMA) -> tuple[Method, ...]:
    """Return the methods of the paper's figure: Gray-world, Shades-of-Gray, Gray-Edge of order 1 at a scale in px."""
    known = standard_methods()
    edge = (
        known["gray-edge-1"]
        if sigma == GRAY_EDGE_SIGMA
        else GrayEdge(f"1st-order Gray-Edge (σ={sigma:g})", 1, 1, sigma)
    )
    return (known["gray-world"], known["shades-of-gray"], edge)


@dataclass(frozen=True, eq=False)
class BitsResult:
    """What methods made of a data set's images, as they are and after bits were set to zero.

    - `raw`: one result a method, on the images as they are.
    - `reduced`: the same by the number of bits set to zero.
    """

    raw: tuple[Result, ...]
    reduced: Mapping[int, tuple[Result, ...]]


def bits_removed(
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    bits: Sequence[int] = BITS,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> BitsResult:
    """Return errors of methods on images with bits set to zero; each image is read once.

    `scenes`: real linear images with their ground truths, at least one.
    """
    truths = require_truths(scenes, methods)

    def answers_for(scene: Scene) -> list[list[SceneAnswer]]:
        image, mask = scene.read()
        # Clipped pixels are known before the reduction only; they have their say in the operator, as in a camera.
        left_out = ~usable(image, scene.saturation, mask)
        versions: list[Image] = [image, *reduce_colours(image, bits, mask)]
        return [[read_estimate(method.estimate(version, None, left_out)) for method in methods] for version in versions]

    answers = list(report_progress(ordered_map(answers_for, scenes, workers), on_scene))
    names = [method.name for method in methods]
    raw, *reduced = (
        collect_results(names, truths, [given[version] for given in answers]) for version in range(1 + len(bits))
    )
    return BitsResult(raw, dict(zip(bits, reduced, strict=True)))


def bits_table(found: BitsResult, kind: ErrorKind, name: str) -> Table:
    """Return the six numbers of every method for the images as they are and each number of bits."""
    versions = {"as it is": found.raw, **{str(count): results for count, results in found.reduced.items()}}
    return Table(
        f"{name}: {kind} angular error after bits of the codes that Flash makes were set to zero, degrees",
        ("Algorithm", "Bits set to zero", *PAPER_COLUMNS[1:]),
        tuple(
            (results[place].method, label, *results[place].summary(kind).as_tuple())
            for place in range(len(found.raw))
            for label, results in versions.items()
        ),
        notes=("0 bits: rounded to codes of 8 bits and taken back, nothing set to zero.",),
    )


PANEL: Final = 200  # Longest side of a panel, px: eight of them fit a page, and the steps of 3 bits can still be seen

_GAP: Final = 6  # White between panels, px

_COLUMNS: Final = 4  # Panels side by side


def reduction_strip(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> npt.NDArray[np.uint8]:
    """Return the panels of a picture with bits set to zero, four in a row, white between them.

    `picture`: (H, W, 3) uint8, sRGB codes; made smaller first if a side is above `PANEL`. Returns (h, w, 3) uint8, sRGB
    codes.
    """
    import cv2

    scale = min(1.0, PANEL / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    width, height = size
    rows = -(-len(bits) // _COLUMNS)
    columns = min(_COLUMNS, len(bits))
    shape = (rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3)
    strip = np.full(shape, 255, np.uint8)
    for place, count in enumerate(bits):
        top, left = place // _COLUMNS * (height + _GAP), place % _COLUMNS * (width + _GAP)
        strip[top : top + height, left : left + width] = clear_bits(small, count)
    return strip


def reduction_table(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> Table:
    """Return what is left of a picture (H, W, 3) uint8, sRGB codes: its colours and its distance from the original."""
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
