"""The photograph of one picture: its raw image, its ground truth, and how it was rendered."""

from __future__ import annotations

import hashlib
import math
import threading
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from generator.dataset.production.options import DatasetOptions
from generator.dataset.production.records import ImageRendering, Triple
from generator.lights.lighting import Lighting
from generator.pictures.picture import Picture

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.rendering.cell_mixtures import CellMixtures
    from generator.rendering.colorimetric import ColorimetricRendering

_threads: Final = threading.local()

Photograph = tuple[npt.NDArray[np.uint16], Triple, list[tuple[str, str, bytes]], ImageRendering | None]
"""Raw image (H, W, 3) uint16, mean chromaticity of its lights, maps of several lights, and how it was rendered."""


def photograph(
    lut: Lut, picture: Picture, lighting: Lighting, options: DatasetOptions, seed: int, number: int
) -> Photograph:
    """Return the photograph of a picture's print.

    Parameters
    ----------
    lut
        The table.
    picture
        (H, W, 3) uint8, sRGB codes; where it is not rendered by colour of colours that the table has samples of.
    lighting
        Its light.
    options
        How it is rendered.
    seed, number
        The dataset's seed, and the image's number in it.

    Raises
    ------
    FormatError
        Samples of the table have changed.
    QualityError
        The table cannot render the picture so under that light.
    """
    from generator.kernels.dithering import dither
    from generator.kernels.mixing import mix_samples
    from generator.kernels.rendering import WHOLE_LIGHT_PIXELS, draw_samples
    from generator.masks.maps import encode_maps

    # The hash of the table stands for its samples in the dataset's description.
    for mixture in lighting.mixtures:
        for light in mixture.lights:
            lut.require_unchanged(light)
    share = options.black_point.share(seed, number)
    cells = None
    record = None
    if options.rendering == "colorimetric":
        reference = rendering_of(lut, options).reference_of(lighting)
        lut.require_unchanged(reference)
        mixtures = rendering_of(lut, options).mixtures(reference)
        outside, distance = _misses(picture, mixtures)
        record = ImageRendering(reference=reference, outside=outside, distance=distance, black_taken=share)
        cells = mixtures.cells
    elif options.black_point.kind != "keep":
        record = ImageRendering(black_taken=share)
    bits = lut.provenance.bits
    alone = lighting.masks is None and len(lighting.mixtures[0].lights) == 1 and not share
    if cells is not None and not (alone or picture.size >= 3 * WHOLE_LIGHT_PIXELS):
        # Of a small picture only the samples of its cells are mixed, or freed of black: they are to be known first.
        picture, cells = dither(picture, cells, bits, seed, number), None
    tables = [_samples(lut, lighting, place, picture, cells is not None, share, seed) for place in range(len(lighting.mixtures))]
    if lighting.masks is None:
        image = draw_samples(tables[0], picture, seed=seed, image=number, cells=cells, out=_reused(picture.shape))
        return image, chromaticity(lighting.whites(lut)[0]), [], record
    if cells is not None:
        picture = dither(picture, cells, bits, seed, number)
    weights = lighting.weights_of(*picture.shape[:2])
    white_level = lut.provenance.white_level
    image = mix_samples(tables, picture, weights, white_level=white_level, seed=seed, image=number)
    return image, chromaticity(lighting.overall(lut, weights)), encode_maps(weights, lighting.whites(lut)), record


def _samples(
    lut: Lut, lighting: Lighting, place: int, picture: Picture, dithered: bool, share: float, seed: int
) -> npt.NDArray[np.uint16]:
    """Return the samples of one of an image's lights, without a share of the print's black.

    Where a picture is dithered while it is drawn, its cells are not known, and all samples are wanted.
    """
    from generator.kernels.palette import colours_in
    from generator.kernels.rendering import WHOLE_LIGHT_PIXELS
    from generator.rendering.black_points import veil_of, without_veil

    mixture = lighting.mixtures[place]
    if not share:
        return mixture.samples(lut, seed, picture)
    samples = mixture.samples(lut, seed, picture)
    colours = None
    if not dithered and picture.size < 3 * WHOLE_LIGHT_PIXELS:
        colours = colours_in(picture, lut.provenance.bits)
    return without_veil(samples, veil_of(lut, mixture, share), lut.provenance.white_level, colours)


@lru_cache(maxsize=4)
def _rendering(lut: Lut, name: str, rows: tuple[float, ...], source: str) -> ColorimetricRendering:
    from generator.rendering.colorimetric import ColorimetricRendering
    from generator.rendering.matrices import ColourMatrix

    return ColorimetricRendering(lut, ColourMatrix(name, np.array(rows).reshape(3, 3), source))


def rendering_of(lut: Lut, options: DatasetOptions) -> ColorimetricRendering:
    """Return the rendering by colour that the options ask for; it keeps what it has found out of a table.

    Raises
    ------
    InputError
        The options have no colour matrix.
    """
    from foundation.errors import InputError

    matrix = options.matrix
    if matrix is None:
        raise InputError("colorimetric rendering needs a colour matrix; give one, or choose rendering by codes")
    return _rendering(lut, matrix.name, tuple(matrix.rows.ravel().tolist()), matrix.source)


def cells_sha256(mixtures: CellMixtures) -> str:
    """Return the SHA-256 of the cells of mixtures, as little-endian uint16 in C order."""
    return hashlib.sha256(mixtures.cells.astype("<u2").tobytes()).hexdigest()


def _misses(picture: Picture, mixtures: CellMixtures) -> tuple[float, float]:
    """Return which share of a picture the print cannot show, and by how many degrees colours are missed in the mean.

    Each pixel counts as the source node nearest to it.
    """
    from generator.kernels.dithering import nearest_nodes

    counts = nearest_nodes(picture)
    total = counts.sum()
    return (
        round(float(counts[mixtures.outside].sum() / total), 6),
        round(float(counts @ mixtures.distance.astype(np.float64) / total), 6),
    )


def _reused(shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """Return an array uint16 of any content in memory of the calling thread, which its next call overwrites.

    Fresh pages take as long to map as the drawing into them.
    """
    size = math.prod(shape)
    memory: npt.NDArray[np.uint16] | None = getattr(_threads, "memory", None)
    if memory is None or memory.size < size:
        _threads.memory = memory = np.empty(size, np.uint16)
    return memory[:size].reshape(shape)


def chromaticity(white: npt.NDArray[np.float64]) -> Triple:
    """Return (r, g, b) of sum 1 of linear RGB (3,) float64."""
    red, green, blue = (float(part) for part in white / white.sum())
    return red, green, blue
