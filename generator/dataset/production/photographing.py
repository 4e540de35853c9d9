"""The photograph of one picture: its raw image, and how it was rendered."""

from __future__ import annotations

import hashlib
import math
import threading
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from generator.dataset.production.options import DatasetOptions
from generator.dataset.production.records import Details
from generator.lights.lighting import Lighting, Mixture
from generator.pictures.picture import Picture

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.kernels.dithering import CellTable
    from generator.rendering.cell_mixtures import CellMixtures
    from generator.rendering.colorimetric import ColorimetricRendering

_threads: Final = threading.local()


def photograph(
    lut: Lut,
    picture: Picture,
    lighting: Lighting,
    options: DatasetOptions,
    seed: int,
    number: int,
    white_level: int,
    black_taken: float | None = None,
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.float32] | None, Details]:
    """Return the raw image of a picture's print.

    `picture`: (H, W, 3) uint8, sRGB codes; where they are those of the print, of colours that the table has samples of.
    `black_taken`: share of the print's black that is taken out, 0 … 1; None for what the options say. Returns (H, W, 3)
    uint16, linear camera RGB; of several lights the weights (H, W, K) float32 of each in each pixel, else None; and
    what is recorded of the rendering.
    """
    from generator.kernels.dithering import dither, nearest_nodes
    from generator.kernels.mixing import mix_samples
    from generator.kernels.rendering import WHOLE_LIGHT_PIXELS, draw_samples
    from generator.rendering.cell_mixtures import summarise

    # The hash of the table stands for its samples in the dataset's description.
    for mixture in lighting.mixtures:
        for light in mixture.lights:
            lut.require_unchanged(light)
    share = options.black_point.share(seed, number) if black_taken is None else black_taken
    cells = grey = None
    details: Details = {}
    if options.rendering == "colorimetric":
        rendering = rendering_of(lut, options)
        for light in rendering.light_of(lighting).lights:
            lut.require_unchanged(light)
        mixtures = rendering.mixtures_for(lighting)
        cells, name = _table(mixtures, lut.provenance.bits)
        grey = mixtures.black
        missed = summarise(mixtures, nearest_nodes(picture).astype(np.float64))
        outside, distance = round(missed.outside, 6), round(missed.distance_deg, 6)
        details |= {"cells": name, "outside": outside, "distance": distance}
    if options.black_point.kind != "keep":
        details["black_taken"] = share
    alone = lighting.masks is None and len(lighting.mixtures[0].lights) == 1 and not share
    if cells is not None and not (alone or (lighting.masks is None and picture.size >= 3 * WHOLE_LIGHT_PIXELS)):
        # Which samples are to be mixed, or freed of black, is known by the cells.
        picture, cells = dither(picture, cells, lut.provenance.bits, seed, number), None
    drawn_dithered = cells is not None
    tables = [_samples(lut, mixture, picture, share, seed, drawn_dithered, grey) for mixture in lighting.mixtures]
    if lighting.masks is None:
        out = _reused(picture.shape)
        return draw_samples(tables[0], picture, seed=seed, image=number, cells=cells, out=out), None, details
    weights = lighting.weights_of(*picture.shape[:2])
    image = mix_samples(tables, picture, weights, white_level=white_level, seed=seed, image=number)
    return image, weights, details


def _samples(
    lut: Lut, mixture: Mixture, picture: Picture, share: float, seed: int, dithered: bool, grey: float | None
) -> npt.NDArray[np.uint16]:
    """Return the samples of a light without a share of the print's black, at least those of a picture's colours.

    A picture that is `dithered` while it is drawn may show any. `grey` is as of `black_points.veil_of`.
    """
    from generator.kernels.choice import colours_in
    from generator.kernels.rendering import WHOLE_LIGHT_PIXELS
    from generator.rendering.black_points import veil_of, without_veil

    samples = mixture.samples(lut, seed, picture)
    if not share:
        return samples
    small = not dithered and picture.size < 3 * WHOLE_LIGHT_PIXELS
    colours = colours_in(picture, lut.provenance.bits) if small else None
    veil = veil_of(lut, mixture, share, grey)
    return without_veil(samples, veil, lut.provenance.white_level, colours)


@lru_cache(maxsize=4)
def _rendering(lut: Lut, name: str, rows: tuple[float, ...], source: str) -> ColorimetricRendering:
    from generator.rendering.colorimetric import ColorimetricRendering
    from generator.rendering.matrices import ColourMatrix

    return ColorimetricRendering(lut, ColourMatrix(name, np.array(rows).reshape(3, 3), source))


def rendering_of(lut: Lut, options: DatasetOptions) -> ColorimetricRendering:
    """Return the rendering by colour that the options ask for; it keeps what it has found out of a table."""
    from generator.rendering.matrices import matrix_for

    matrix = options.matrix or matrix_for(lut)
    return _rendering(lut, matrix.name, tuple(matrix.rows.ravel().tolist()), matrix.source)


@lru_cache(maxsize=8)
def _table(mixtures: CellMixtures, bits: int) -> tuple[CellTable, str]:
    """Return the cells of mixtures to draw from, and what they are called: the first 16 digits of their SHA-256."""
    from generator.kernels.dithering import checked_cells

    digest = hashlib.sha256(mixtures.cells.astype("<u2").tobytes()).hexdigest()
    return checked_cells(mixtures.cells, bits), digest[:16]


def _reused(shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """Return an array uint16 of any content in memory of the calling thread, which its next call overwrites.

    Fresh pages take as long to map as the drawing into them.
    """
    size = math.prod(shape)
    memory: npt.NDArray[np.uint16] | None = getattr(_threads, "memory", None)
    if memory is None or memory.size < size:
        _threads.memory = memory = np.empty(size, np.uint16)
    return memory[:size].reshape(shape)
