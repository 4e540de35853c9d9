"""Generate raw linear images and data sets from a look-up table (LUT) and any picture.

Three lines calculate the raw image that the camera would take of the printed picture::

    from generator import open_lut, read_picture, render
    lut = open_lut("LUT")
    raw = render(lut, read_picture("cat.jpg"), light=12, seed=0)     # (H, W, 3) uint16, linear camera RGB
    truth = lut.ground_truth[12]                                     # (3,) float64, r + g + b = 1

Each name is loaded at its first use, because compiled and imaging libraries take long to load.
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

# Module of each public name.
_MODULE_OF_NAME = {
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
    """Open a look-up table (LUT).

    Parameters
    ----------
    folder
        Folder of the LUT, or ``demo:`` for a small computed LUT.

    Returns
    -------
    Lut
        The LUT; its samples are read from the disk when they are used.

    Raises
    ------
    FormatError
        The folder contains no LUT, or the LUT is damaged.

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
    if name in _MODULE_OF_NAME:
        return getattr(import_module(_MODULE_OF_NAME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
