"""From a look-up table and any picture to raw linear images and whole datasets.

Three lines from a table and a picture to the raw image a camera would have taken of the picture's print::

    from generator import open_lut, read_picture, render
    lut = open_lut("LUT")
    raw = render(lut, read_picture("cat.jpg"), light=12, seed=0)     # (H, W, 3) uint16, linear camera RGB
    truth = lut.ground_truth[12]                                     # (3,) float64, r + g + b = 1

What is imported from here is loaded when it is first used, because compiled and imaging libraries take their time.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.dataset.making import Workers, generate_dataset
    from generator.dataset.plan import DatasetOptions
    from generator.dataset.reader import open_dataset
    from generator.dataset.shards import Callbacks
    from generator.files import flash
    from generator.kernels.mixing import mix_samples, mixed_table
    from generator.kernels.planar import draw_batch
    from generator.kernels.rendering import draw_samples
    from generator.pictures.sources import find_pictures, read_picture
    from generator.rendering.render import render

__all__ = [
    "Callbacks",
    "DatasetOptions",
    "Workers",
    "draw_batch",
    "draw_samples",
    "find_pictures",
    "flash",
    "generate_dataset",
    "mix_samples",
    "mixed_table",
    "open_dataset",
    "open_lut",
    "read_picture",
    "render",
]

_HOMES = {
    "Callbacks": "generator.dataset.shards",
    "DatasetOptions": "generator.dataset.plan",
    "Workers": "generator.dataset.making",
    "draw_batch": "generator.kernels.planar",
    "draw_samples": "generator.kernels.rendering",
    "find_pictures": "generator.pictures.sources",
    "flash": "generator.files",
    "generate_dataset": "generator.dataset.making",
    "mix_samples": "generator.kernels.mixing",
    "mixed_table": "generator.kernels.mixing",
    "open_dataset": "generator.dataset.reader",
    "read_picture": "generator.pictures.sources",
    "render": "generator.rendering.render",
}


def open_lut(folder: Path | str) -> Lut:
    """Return the table in a folder, or the small computed one of ``demo:``; see `calibration.table.lut.open_lut`.

    Examples
    --------
    >>> lut = open_lut("lut")
    >>> lut.samples.shape, lut.samples.dtype, lut.ground_truth.shape
    ((4, 64, 25, 3), dtype('uint16'), (4, 3))
    """
    from calibration.table.demo_table import table_folder
    from calibration.table.lut import open_lut

    return open_lut(table_folder(Path(folder)))


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
