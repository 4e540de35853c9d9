"""Rendering by colour: from a table, a light and a colour matrix to the cells that show the colours of a picture.

What the camera should see of a source colour is C · linear sRGB, C being the colour matrix of its body. The print's
black is not black and its paper not white, so black goes to the print's black point b and white to its white point w,
as black point compensation does between two media (ISO 18619:2015, clause 5; there in XYZ, here in camera RGB): t = b
+ (w - b) a.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from foundation.hashing import sha256_of
from generator.lights.gamut import black_body
from generator.lights.lighting import Lighting, Mixture, plain
from generator.rendering import cell_mixtures, print_profiles, source_colours
from generator.rendering.cell_mixtures import CellMixtures, mix_cells
from generator.rendering.kept_mixtures import keep_mixtures, load_mixtures
from generator.rendering.matrices import ColourMatrix
from generator.rendering.print_profiles import PrintProfile, profile_of
from generator.rendering.reference_lights import nearest_reference, reference_lights
from generator.rendering.table_matrix import matrix_for

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_MIXTURES_AT_HAND: Final = 16
"""Mixtures kept in memory, 3 MB each: lights of pictures that follow each other share references."""


def wanted_colours(profile: PrintProfile, matrix: ColourMatrix) -> npt.NDArray[np.float64]:
    """Return what the camera should see of each source node on a print, (32768, 3) float64 over the white of the light.

    Parameters
    ----------
    profile
        The print: its black and white points.
    matrix
        Linear sRGB to the camera's RGB.
    """
    seen = source_colours.source_colours(matrix)
    return profile.black + (profile.white - profile.black) * seen


def colorimetric_mixtures(
    lut: Lut, light: float | Mixture, matrix: ColourMatrix | None = None, folder: Path | None = None
) -> CellMixtures:
    """Return for each source node the cells of a table that show it under a light; kept on disk for the next time.

    Parameters
    ----------
    lut
        The table.
    light
        A light of the table by its number (int), a black body between those of the table by its temperature in kelvin
        (float), or any mixture of lights.
    matrix
        Linear sRGB to the camera's RGB; None for what `matrix_for` gives.
    folder
        Where mixtures are kept; None for `kept_mixtures.cache_folder`.

    Raises
    ------
    InputError
        The table has no such light.
    QualityError
        No cell of the table can be trusted under that light.
    """
    if not isinstance(light, Mixture):
        light = black_body(lut, light) if isinstance(light, float) else plain(int(light))
    light.white(lut)
    return _mixtures(lut, light, matrix_for(lut) if matrix is None else matrix, folder)


@dataclass(frozen=True, eq=False)
class ColorimetricRendering:
    """Rendering by colour with a table: which mixtures of cells an image is made of.

    Attributes
    ----------
    lut
        The table.
    matrix
        Linear sRGB to the camera's RGB.
    """

    lut: Lut
    matrix: ColourMatrix

    @cached_property
    def references(self) -> tuple[int, ...]:
        """The lights of the table under which profiles are made."""
        return reference_lights(self.lut.white)

    def reference_of(self, lighting: Lighting) -> int:
        """Return the reference whose profile serves an image: the nearest to its light.

        Of several lights on an image it is the nearest to their sum, each as bright as the others in the mean of its
        channels: all of them see the same print, so it can be right for one colour of light only.
        """
        whites = lighting.whites(self.lut)
        light = (whites / whites.sum(axis=1, keepdims=True)).sum(axis=0)
        return nearest_reference(self.references, self.lut.white, light)

    def mixtures(self, reference: int) -> CellMixtures:
        """Return the mixtures (32768 of them) of a reference."""
        return colorimetric_mixtures(self.lut, reference, self.matrix)


@lru_cache(maxsize=_MIXTURES_AT_HAND)
def _kept(lut: Lut, light: Mixture, name: str, rows: tuple[float, ...], folder: Path | None) -> CellMixtures:
    matrix = ColourMatrix(name, np.array(rows).reshape(3, 3), "")
    key = _key(lut, light, rows)
    found = load_mixtures(key, source_colours.NODES, folder)
    if found is None:
        profile = profile_of(lut, light)
        found = mix_cells(profile, wanted_colours(profile, matrix))
        keep_mixtures(key, found, folder)
    return found


def _mixtures(lut: Lut, light: Mixture, matrix: ColourMatrix, folder: Path | None) -> CellMixtures:
    return _kept(lut, light, matrix.name, tuple(matrix.rows.ravel().tolist()), folder)


def _key(lut: Lut, light: Mixture, rows: tuple[float, ...]) -> str:
    """Return what mixtures are kept under: a hash of all that they depend on."""
    depends = {
        "table": lut.sha256,
        "light": light.label,
        "matrix": [row.hex() for row in rows],
        "code": _code(),
    }
    return sha256_of(json.dumps(depends).encode())


@lru_cache(maxsize=1)
def _code() -> str:
    """Return a hash of the code that computes mixtures, so that those of older code are not taken for its own."""
    modules = (print_profiles, source_colours, cell_mixtures)
    files = [Path(str(module.__file__)) for module in modules] + [Path(__file__)]
    return sha256_of(b"".join(file.read_bytes() for file in files))
