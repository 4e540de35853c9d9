"""Rendering by colour: from a table, a light and a colour matrix to the cells that show the colours of a picture.

What the camera should see of a source colour is a = C · linear sRGB, C being the colour matrix of its body. The
print's black is not black and its paper not white, so black goes to the print's black point b and white to its white
point w, as black point compensation does between two media (ISO 18619:2015; there in XYZ, here in camera RGB): t = b +
(w - b) a.

Mixtures of cells are exact for the lights of a table one by one, which are made once and kept. A mixture of lights, or
several lights on an image, are one light more with nearly every image. There the mixtures are those of the table's
light that is nearest, but colours near grey, by which the eye and every estimator know a light, are mixed anew for the
very light of the image.

Source colours are nodes: of each channel 32 sRGB codes 255 k / 31, k = 0 … 31. A picture's codes lie between nodes,
and are shared out among them by dithering.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from calibration.radiometry.greys import tint_deg
from foundation.colorimetry import decode_srgb
from generator.kernels.choice import channels_of
from generator.rendering.matrices import ColourMatrix

if TYPE_CHECKING:
    from calibration.table.lut import Lut
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

from foundation.colorimetry import angles_deg
from foundation.errors import QualityError
from foundation.files import sha256_of
from generator.lights.gamut import black_body
from generator.lights.lighting import Lighting, Mixture, mixture_of, plain
from generator.rendering import cell_mixtures, print_profiles
from generator.rendering.cell_mixtures import (
    CellMixtures,
    are_kept,
    keep_mixtures,
    load_mixtures,
    mix_cells,
    mixtures_of,
    near_grey,
)
from generator.rendering.matrices import matrix_for
from generator.rendering.print_profiles import PrintProfile, mixed_profile, profile_of

NODE_BITS: Final = 5
"""Bits of a channel of the source nodes: at 32 codes a channel, interpolating between nodes errs by less than the
samples of a cell differ."""

NODES: Final = 8**NODE_BITS
"""Number of source nodes."""


def node_codes() -> npt.NDArray[np.float64]:
    """Return the sRGB codes 0 … 1 of the source nodes, (32768, 3) float64; node (r << 10) | (g << 5) | b.

    Examples
    --------
    >>> node_codes()[[0, 31, 32767]].tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    """
    return channels_of(np.arange(NODES), NODE_BITS) / (2.0**NODE_BITS - 1)


def source_colours(matrix: ColourMatrix) -> npt.NDArray[np.float64]:
    """Return what the camera should see of each source node, over white: clip(C · linear sRGB, 0, 1).

    `matrix`: linear sRGB to camera RGB, rows of sum 1, so that a grey is a grey to the camera, too. Returns (32768, 3)
    float64, 0 … 1.

    Examples
    --------
    >>> from generator.rendering.matrices import camera_matrix
    >>> source_colours(camera_matrix("550D"))[[0, 31, 32767]].round(3).tolist()
    [[0.0, 0.0, 0.0], [0.079, 0.238, 0.748], [1.0, 1.0, 1.0]]
    """
    return np.clip(decode_srgb(node_codes()) @ matrix.rows.T, 0.0, 1.0)


DARKEST: Final = 0.1
"""Share of white below which a grey is left out: the tint of ink black is not what a picture's greys suffer from."""


def grey_tint_deg(lut: Lut) -> tuple[float, int] | None:
    """Return the largest angle between a grey of the print and the light, and the light it was found under.

    Greys are the chart's cells with three equal codes between black and white, as the camera sees them under the light
    of the table that is brightest in its darkest channel; cells that are unfit or dark are left out.

    Returns the angle in degrees, and the number of the light; None where the chart has no such grey.

    Examples
    --------
    >>> from pathlib import Path
    >>> from calibration.table.lut import open_lut
    >>> angle, light = grey_tint_deg(open_lut(Path("lut")))
    >>> round(angle, 1), light
    (0.6, 0)
    """
    bits, light = lut.provenance.bits, int(np.argmax(lut.white.min(axis=1)))
    levels = np.arange(1, (1 << bits) - 1)
    cells = levels * (1 | 1 << bits | 1 << 2 * bits)
    unfit = [cell.colour for cell in lut.provenance.unfit]
    cells = cells[~np.isin(cells, unfit)]
    white = lut.white[light]
    greys = lut.samples[light, cells].mean(axis=1, dtype=np.float64)
    greys = greys[(greys / white).min(axis=1) > DARKEST]
    return (float(tint_deg(white, greys).max()), light) if len(greys) else None


BLACK_WITHIN_DEG: Final = 0.4
"""Angle to grey of the black that is asked of a print, degrees: a little less than the half that greys may be off."""

MOST_LIFT: Final = 1.25
"""Black point over the darkest grey that cells make at most. Simulated unmanaged prints need 1.0 to 1.2; a lift of 1.25
makes the contrast of a print less by a hundredth of white."""

_MIXTURES_AT_HAND: Final = 16
"""Lights whose mixtures are kept in memory, 3 MB each: pictures that follow each other share some."""

_asked_for: Final[set[str]] = set()
"""Keys of mixtures of lights that were found in this process. One that is found a second time is kept: pictures go
through a list of lights that is longer than what is in memory. Of lights drawn at random each has one image, and to
keep them would push out those of the table's own lights."""

_PROFILES_AT_HAND: Final = 64
"""Lights whose profiles are kept in memory, 1 MB each: mixtures of lights share their parts."""


def wanted_colours(profile: PrintProfile, matrix: ColourMatrix) -> npt.NDArray[np.float64]:
    """Return what the camera should see of each source node on a print, (32768, 3) float64 over the white of the light.

    `matrix`: linear sRGB to the camera's RGB.
    """
    black = black_point(profile)
    return black + (profile.white - black) * source_colours(matrix)


def black_point(profile: PrintProfile) -> float:
    """Return what black is mapped to: the darkest grey that cells near to it make; 1 = ideal white.

    At the very edge of the gamut cells of unlike colours would have to be mixed. So the darkest is taken, of greys from
    the print's own black to one a quarter brighter, that is off by no more than `BLACK_WITHIN_DEG`; if there is none,
    as on charts of few cells, the print's own black.

    Examples
    --------
    >>> ramp = np.linspace(0.04, 0.9, 8)[:, None] * np.ones(3)
    >>> round(black_point(PrintProfile(ramp, np.ones(8, bool))), 6)
    0.04
    """
    levels = profile.black * np.linspace(1.0, MOST_LIFT, 26)
    levels = levels[levels <= profile.white]
    met = mix_cells(profile, levels[:, None] * np.ones(3)).distance <= BLACK_WITHIN_DEG
    return float(levels[int(met.argmax())])


def colorimetric_mixtures(
    lut: Lut, light: float | Mixture, matrix: ColourMatrix | None = None, folder: Path | None = None
) -> CellMixtures:
    """Return for each source node the cells of a table that show it under a light.

    Those of a light of the table are kept on disk for the next time.

    `light`: A light of the table by its number (int), a black body between those of the table by its temperature in
    kelvin (float), or any mixture of lights. `matrix`: linear sRGB to the camera's RGB; None for what `matrix_for`
    gives. `folder`: where mixtures are kept; None for `kept_mixtures.cache_folder`.
    """
    if not isinstance(light, Mixture):
        light = black_body(lut, light) if isinstance(light, float) else plain(int(light))
    light.white(lut)
    matrix = matrix_for(lut) if matrix is None else matrix
    return _mixtures(lut, light, tuple(matrix.rows.ravel().tolist()), folder)


@dataclass(frozen=True, eq=False)
class ColorimetricRendering:
    """Rendering by colour with a table: which mixtures of cells an image is made of.

    `matrix`: linear sRGB to the camera's RGB.
    """

    lut: Lut
    matrix: ColourMatrix

    def light_of(self, lighting: Lighting) -> Mixture:
        """Return the light for which an image's cells are chosen.

        Of several lights on an image it is their sum, each as bright as the others: all of them fall on the same print,
        so it can be right for one colour of light only.
        """
        shares: dict[int, float] = {}
        for mixture, white in zip(lighting.mixtures, lighting.whites(self.lut), strict=True):
            for light, weight in zip(mixture.lights, mixture.weights, strict=True):
                shares[light] = shares.get(light, 0.0) + weight / float(white.sum())
        return mixture_of(shares)

    def mixtures_for(self, lighting: Lighting) -> CellMixtures:
        """Return the mixtures, 32768 of them, for an image."""
        return colorimetric_mixtures(self.lut, self.light_of(lighting), self.matrix)


def lights_to_find(
    rendering: ColorimetricRendering, lightings: Iterable[Lighting], folder: Path | None = None
) -> frozenset[int]:
    """Return the lights of the table whose cells images need and that are not kept: each takes a second or more.

    `folder`: where mixtures are kept; None for `kept_mixtures.cache_folder`.
    """
    lut, rows = rendering.lut, tuple(rendering.matrix.rows.ravel().tolist())
    mixtures = {rendering.light_of(lighting) for lighting in lightings}
    needed = {_kept_for(lut, light) for light in mixtures}
    return frozenset(light for light in needed if not are_kept(_key(lut, plain(light), rows), folder))


@lru_cache(maxsize=_MIXTURES_AT_HAND)
def _mixtures(lut: Lut, light: Mixture, rows: tuple[float, ...], folder: Path | None) -> CellMixtures:
    matrix = ColourMatrix("", np.array(rows).reshape(3, 3), "")
    first, *others = light.lights
    key = _key(lut, light, rows)
    found = load_mixtures(key, NODES, folder)
    if found is not None:
        return found
    if others:
        found = _mixtures_near_grey(lut, light, matrix, folder)
        if key in _asked_for:
            keep_mixtures(key, found, folder)
        _asked_for.add(key)
    else:
        profile = _profile(lut, first)
        if 2 * profile.black >= profile.white:
            raise QualityError(
                f"under light {first} the table {lut.folder} has a black as bright as {profile.black:.2g} of white, "
                "expected less than half of its paper: its cell is spoilt or the print has no contrast; leave the "
                "light out, build the table again, or render by codes"
            )
        found = mix_cells(profile, wanted_colours(profile, matrix))
        keep_mixtures(key, found, folder)
    return found


def _mixtures_near_grey(lut: Lut, light: Mixture, matrix: ColourMatrix, folder: Path | None) -> CellMixtures:
    """Return the mixtures of the light of the table that is nearest to `light`, those near grey mixed for `light`."""
    base = colorimetric_mixtures(lut, _kept_for(lut, light), matrix, folder)
    profile = mixed_profile(
        [_profile(lut, number) for number in light.lights],
        np.array(light.weights)[:, None] * lut.white[list(light.lights)],
    )
    wanted = wanted_colours(profile, matrix)
    # A cell that is odd or clipped under one of the lights of the mixture alone may be among those of the nearest.
    anew = near_grey(wanted) | ~profile.usable[base.cells].all(axis=1)
    again = mix_cells(profile, wanted[anew])
    cells = base.cells.copy()
    cells[anew] = again.cells
    return mixtures_of(cells, profile, wanted)


def _kept_for(lut: Lut, light: Mixture) -> int:
    """Return the light of a table whose cells serve a light: itself, or the one whose white is nearest to a mixture."""
    first, *others = light.lights
    return int(angles_deg(lut.white, light.white(lut)).argmin()) if others else first


@lru_cache(maxsize=_PROFILES_AT_HAND)
def _profile(lut: Lut, light: int) -> PrintProfile:
    return profile_of(lut, light)


def _key(lut: Lut, light: Mixture, rows: tuple[float, ...]) -> str:
    """Return what mixtures are kept under: a hash of all that they depend on."""
    depends = {
        "table": lut.sha256,
        "light": light.label,
        "matrix": [row.hex() for row in rows],
        "code": _code(),
        # Of cells that are equally good the last digits choose, and other versions may have others.
        "libraries": _libraries(version),
    }
    return sha256_of(json.dumps(depends).encode())


@lru_cache(maxsize=1)
def _libraries(version_of: Callable[[str], str]) -> dict[str, str]:
    """Return versions of libraries; a key is made of each light, and to read one takes milliseconds."""
    return {name: version_of(name) for name in ("numpy", "scipy")}


@lru_cache(maxsize=1)
def _code() -> str:
    """Return a hash of the code that computes mixtures, so that those of older code are not taken for its own."""
    modules = (print_profiles, cell_mixtures)
    files = [Path(str(module.__file__)) for module in modules] + [Path(__file__)]
    return sha256_of(b"".join(file.read_bytes() for file in files))
