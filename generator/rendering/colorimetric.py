"""Rendering by colour: a picture is printed through the chart's own profile, as a print shop prints through one.

What the camera should see of a source colour is a = C · linear sRGB, C being the colour matrix of its body. The
print's black is not black and its paper not white, so black goes to the print's black point b and white to its white
point w, as black point compensation does between two media (ISO 18619:2015; there in XYZ, here in camera RGB): t = b +
(w - b) a.

Once a table, for each of 17 x 17 x 17 source colours (`kernels.printing.NODE_CODES`) the place in the chart is found
where the camera sees t under a reference light (`print_inverse`). That is what a printer's profile is: it does not
depend on the light that will fall on the print. Under a light of the table a node is the mean of the cells around its
place, interpolated; under lights together it is the sum of theirs, as light adds. So a light, or a mixture of lights,
costs a few milliseconds and nothing is kept of it but in memory.

A print's greys drift with the light, as real ones do, and by degrees where inks are not neutral. Estimators know a
light by greys, and the eye does: so greys of a light are made neutral, each level by a factor for each channel that
keeps its brightness, and colours share the factor of the grey that is as bright.

The noise of a pixel is recorded: `kernels/printing.py` says how.
"""

from __future__ import annotations

import contextlib
import json
import threading
import uuid
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import version
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import CropError, InputError, QualityError
from foundation.files import atomic_file, sha256_of
from foundation.folders import cache_folder
from generator.kernels import printing
from generator.kernels.choice import channels_of
from generator.kernels.printing import NODE_CODES, NODES, SIDE, PrintedLight, means_at
from generator.lights.lighting import Mixture
from generator.rendering import print_inverse, print_profiles
from generator.rendering.black_points import veil_of
from generator.rendering.matrices import ColourMatrix
from generator.rendering.print_inverse import corners, invert, nearest_to
from generator.rendering.print_profiles import PrintProfile, profile_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_Array = npt.NDArray[np.float64]

# Temperature of the light under which places are found, kelvin: about the middle of daylight. Maps of 5600 K trained
# estimators as well as maps of each light (docs/transfer.md).
REFERENCE_K: Final = 5600.0

# Least of a channel's white over the largest under which a light may be the reference: it must see all colours.
_LEAST_RATIO: Final = 0.2

# Largest relative difference in a channel of a place that shows the wanted colour: a fifth of what neighbouring cells
# of a chart of five bits differ.
MET_WITHIN: Final = 0.02

# Angle to grey of the black that is asked of a print, degrees: a little less than the half that greys may be off.
BLACK_WITHIN_DEG: Final = 0.4

# Black point over the darkest grey that the print makes at most. Simulated unmanaged prints need 1.0 to 1.2; a lift
# of 1.25 makes the contrast of a print less by a hundredth of white.
MOST_LIFT: Final = 1.25

# Largest factor by which a channel of greys is made neutral. Prints need up to 1.1; a channel in which a light has
# hardly any counts may ask for more, of noise.
MOST_TINT: Final = 1.5

# Largest factor by which recorded deviations are made as large as the noise is at their level: 25 of them have a
# spread of their own that is off by a seventh, and that of the nearest cell is of another level.
MOST_SPREAD: Final = 2.0

# Standard deviations of noise that are left between a mean and 0 where black is taken out: what is cut off then lifts
# a mean by 2 %.
NOISE_ABOVE: Final = 1.5

# Steps of a code, and of a level, that places are known to: a thousandth of what neighbouring cells differ, and far
# more than rounding leaves between processors.
_STEPS: Final = 1024

_GREYS: Final = np.arange(SIDE) * (SIDE * SIDE + SIDE + 1)  # Nodes of three equal codes

_LIGHTS_AT_HAND: Final = 1024  # Lights of a table whose nodes are kept in memory, 200 kB each


def source_colours(matrix: ColourMatrix) -> _Array:
    """Return what the camera should see of each node, over white: clip(C · linear sRGB, 0, 1), (4913, 3) float64.

    `matrix`: linear sRGB to camera RGB, rows of sum 1, so that a grey is a grey to the camera, too.
    """
    channel = decode_srgb(np.array(NODE_CODES) / 255)
    linear = np.stack(np.meshgrid(channel, channel, channel, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.clip(linear @ matrix.rows.T, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class PrintMap:
    """Where in a chart the nodes are, and what is known of it.

    - `cells`: (U,) int64, the cells that nodes need.
    - `around`: (4913, 8) int64, places in `cells` of those around each node; `weights`: (4913, 8) float64, sum 1.
    - `nearest`: (4913,) int64, place in `cells` of the cell whose samples a node has.
    - `levels`: (4913,) float64, 0 … 16: which grey is as bright as a node, counted in grey nodes.
    - `distance`: (4913,) float64, angle between what the place shows and the wanted colour, degrees.
    - `outside`: (4913,) bool, whether the print cannot show the colour: a channel is off by more than `MET_WITHIN`.
    - `noise`: (3, 3) float64: what the variance of a sample is of 1, y and y² at y counts, a column a channel; 0 where
      the table's noise cannot be measured.
    """

    cells: npt.NDArray[np.int64]
    around: npt.NDArray[np.int64]
    weights: _Array
    nearest: npt.NDArray[np.int64]
    levels: _Array
    distance: _Array
    outside: npt.NDArray[np.bool_]
    noise: _Array

    @cached_property
    def sha256(self) -> str:
        """Hash of what decides pixels."""
        parts = self.cells.astype("<i8"), self.around.astype("<i8"), self.weights.astype("<f8")
        parts = *parts, self.nearest.astype("<i8"), self.levels.astype("<f8"), self.noise.astype("<f8")
        return sha256_of(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))

    def missed(self, counts: npt.NDArray[np.int64]) -> tuple[float, float]:
        """Return what a print makes of a picture: share of pixels outside its gamut 0 … 1, and mean angle, degrees.

        `counts`: (4913,) int64, how many pixels are nearest to each node, as from `printing.nearest_nodes`.
        """
        shares = counts / counts.sum()
        return float(shares @ self.outside), float(shares @ self.distance)


_finding: Final = threading.Lock()  # Held while a map is read or found, so that of several threads one does so

_KEPT: Final = tuple(PrintMap.__dataclass_fields__)
_SUFFIX: Final = ".print"


def print_map(lut: Lut, matrix: ColourMatrix, folder: Path | None = None) -> PrintMap:
    """Return the map of a table's print for a colour matrix; it is kept on disk for the next time.

    A file that is damaged or unreadable is as good as none, and where nothing can be written nothing is kept: seconds
    of work are no reason to fail.

    `folder`: where maps are kept; None for `cache_folder`.
    """
    depends = {
        "table": lut.sha256,
        "matrix": [float(part).hex() for part in matrix.rows.ravel()],
        "code": _code(),
        "numpy": version("numpy"),
    }
    folder = folder or cache_folder()
    path = None if folder is None else folder / f"{sha256_of(json.dumps(depends).encode())}{_SUFFIX}"
    found = _load(path)
    if found is None:
        found = find_map(lut, matrix)
        _keep(found, path)
    return found


def _load(path: Path | None) -> PrintMap | None:
    if path is None:
        return None
    with contextlib.suppress(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as kept:
            found = PrintMap(**{name: kept[name] for name in _KEPT})
        if found.around.shape == found.weights.shape == (NODES, 8) and len(found.nearest) == NODES:
            return found
    return None


def _keep(found: PrintMap, path: Path | None) -> None:
    if path is None:
        return
    stream = BytesIO()
    arrays: dict[str, Any] = {name: getattr(found, name) for name in _KEPT}
    np.savez_compressed(stream, **arrays)
    # Workers may come here at the same time: each writes a file of its own, and the last to finish names it.
    own = path.with_name(f"{path.stem}-{uuid.uuid4().hex}")
    with contextlib.suppress(CropError, OSError), atomic_file(own, lambda: path) as file:
        file.write(stream.getvalue())


@lru_cache(maxsize=1)
def _code() -> str:
    """Return a hash of the code that finds maps, so that those of older code are not taken for its own."""
    modules = [module.__name__ for module in (print_profiles, print_inverse, printing)]
    found = [find_spec(name) for name in (*modules, "calibration.radiometry.table_noise", __name__)]
    files = [Path(str(one.origin)) for one in found if one is not None]
    return sha256_of(b"".join(file.read_bytes() for file in files))


def reference_light(lut: Lut) -> int:
    """Return the light under which places are found: the black body nearest to 5600 K.

    Of a table without black bodies that see all colours, the light whose white is the most even.
    """
    ratio = lut.white.min(axis=1) / lut.white.max(axis=1)
    bodies = [
        (abs(1e6 / light.cct_k - 1e6 / REFERENCE_K), light.index)
        for light in lut.illuminations
        if light.cct_k is not None and ratio[light.index] >= _LEAST_RATIO
    ]
    return min(bodies)[1] if bodies else int(ratio.argmax())


def find_map(lut: Lut, matrix: ColourMatrix) -> PrintMap:
    """Return the map of a table's print for a colour matrix: it takes seconds.

    A QualityError says that no cell can be used, or that the print has no contrast.
    """
    light, bits = reference_light(lut), lut.provenance.bits
    profile = profile_of(lut, light)
    _require_contrast(lut, light, profile.black, profile.white)
    usable = profile.usable & _usable_elsewhere(lut, light)
    if not usable.any():
        usable = profile.usable
    colours = _filled(profile.colours, usable, bits)
    black = black_point(profile, colours, bits)
    share = source_colours(matrix)
    wanted = black + (profile.white - black) * share
    # Last digits differ between processors and libraries, and pixels are not to.
    places = _rounded(invert(colours, wanted.mean(axis=1), wanted, bits))
    around, weights = corners(places, bits)
    weights = weights * usable[around]
    sums = weights.sum(axis=1)
    nearest = _nearest(places, np.flatnonzero(usable), bits)
    lost = sums < 1e-6
    weights[lost], around[lost] = np.eye(8)[0], nearest[lost, None]
    weights[~lost] /= sums[~lost, None]
    seen = np.einsum("kc,kcx->kx", weights, profile.colours[around])
    cells, places_of = np.unique(np.concatenate([around.ravel(), nearest]), return_inverse=True)
    brightness = np.asarray(share.mean(axis=1), np.float64)
    levels = _rounded(np.asarray(np.interp(brightness, brightness[_GREYS], np.arange(SIDE)), np.float64))
    return PrintMap(
        cells,
        places_of[: NODES * 8].reshape(NODES, 8),
        weights,
        places_of[NODES * 8 :],
        levels,
        angles_deg(seen, wanted),
        np.asarray((np.abs(seen - wanted) > MET_WITHIN * wanted).any(axis=1)),
        _noise_of(lut),
    )


def _rounded(numbers: _Array) -> _Array:
    return np.round(numbers * _STEPS) / _STEPS


def _require_contrast(lut: Lut, light: int | str, black: float, white: float) -> None:
    if 2 * black >= white:
        raise QualityError(
            f"under light {light} the table {lut.folder} has a black as bright as {black:.2g} of white, "
            "expected less than half of its paper: its cell is spoilt or the print has no contrast; leave the "
            "light out, build the table again, or render by codes (--rendering codes)"
        )


def _usable_elsewhere(lut: Lut, reference: int) -> npt.NDArray[np.bool_]:
    """Return which cells are usable under the lights that are darkest in a channel, where odd photosites show most."""
    others = {int(light) for light in lut.white.argmin(axis=0)} - {reference}
    usable = np.ones(8**lut.provenance.bits, bool)
    for light in others:
        with contextlib.suppress(QualityError):
            usable &= profile_of(lut, light).usable
    return usable


def _filled(colours: _Array, usable: npt.NDArray[np.bool_], bits: int) -> _Array:
    """Return colours (8**bits, 3) > 0 with those of cells that are not usable taken from the nearest that is."""
    lost, fit = np.flatnonzero(~usable), np.flatnonzero(usable)
    filled = colours.copy()
    if len(lost):
        filled[lost] = colours[_nearest(channels_of(lost, bits), fit, bits)]
    return filled


def _nearest(places: npt.NDArray[Any], cells: npt.NDArray[np.int64], bits: int) -> npt.NDArray[np.int64]:
    """Return for each place in the chart (K, 3) the nearest of some cells (N,), (K,) int64."""
    from scipy.spatial import KDTree

    tree: Any = KDTree(channels_of(cells, bits))
    return cells[np.asarray(tree.query(places)[1], np.int64)]


def black_point(profile: PrintProfile, colours: _Array, bits: int) -> float:
    """Return what black is mapped to: the darkest grey that the print shows; 1 = ideal white.

    The darkest is taken, of greys from the print's own black to one a quarter brighter, that is off by no more than
    `BLACK_WITHIN_DEG`; if there is none, the print's own black.

    `colours`: (8**bits, 3) float64, those of the profile without cells that are not usable.
    """
    levels = profile.black * np.linspace(1.0, MOST_LIFT, 26)
    levels = levels[levels <= profile.white]
    wanted = levels[:, None] * np.ones(3)
    around, weights = corners(nearest_to(colours, wanted, np.full((len(levels), 3), 0.5), bits), bits)
    met = angles_deg(np.einsum("kc,kcx->kx", weights, colours[around]), wanted) <= BLACK_WITHIN_DEG
    return float(levels[int(met.argmax())])


def _noise_of(lut: Lut) -> _Array:
    """Return what variances are of 1, y and y² at y counts, (3, 3), a column a channel; 0 where that is not known."""
    # It loads scipy and cv2.
    from calibration.radiometry.table_noise import noise_curve

    with contextlib.suppress(InputError):
        curve = noise_curve(lut)
        if curve is not None:
            terms = np.stack([curve.read_noise**2, 1 / curve.gain_e, curve.response**2])
            return np.array([[float(f"{term:.6g}") for term in row] for row in terms.tolist()])
    return np.zeros((3, 3))


@dataclass(frozen=True, eq=False)
class ColorimetricRendering:
    """Rendering by colour with a table.

    `matrix`: linear sRGB to the camera's RGB. `folder`: where the map of the print is kept; None for `cache_folder`.
    """

    lut: Lut
    matrix: ColourMatrix
    folder: Path | None = None

    @cached_property
    def map(self) -> PrintMap:
        """Where in the chart source colours are."""
        with _finding:
            return print_map(self.lut, self.matrix, self.folder)

    @cached_property
    def cells(self) -> npt.NDArray[np.uint32]:
        """(4913,) uint32, the cell whose samples each node has."""
        return self.map.cells[self.map.nearest].astype(np.uint32)

    @cached_property
    def _lights(self) -> Any:
        return lru_cache(maxsize=_LIGHTS_AT_HAND)(self._nodes_of)

    def _nodes_of(self, light: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return what the camera sees of nodes under a light of the table, (4913, 3) counts, and of their cells.

        Of cells (4913, 2, 4): means, and what deviations are multiplied by to be as large as the table's noise is at
        the node; the fourth is not used.
        """
        found, samples = self.map, self.lut.light_samples(light)
        means, spreads, own = np.empty((NODES, 3)), np.empty((NODES, 3)), np.zeros((NODES, 2, 4), np.float32)
        seen = np.empty((NODES, 3))
        means_at(np.asarray(samples), found.around, found.weights, found.nearest, found.cells, means, seen, spreads)
        own[:, 0, :3], own[:, 1, :3] = seen, 1.0
        if found.noise.any():
            factors = np.sqrt(self._variance(means) / np.maximum(spreads, 1e-6))
            own[:, 1, :3] = np.where(spreads > 0, np.clip(factors, 1 / MOST_SPREAD, MOST_SPREAD), 0.0)
        return means.astype(np.float32), own

    def seen(self, light: Mixture) -> _Array:
        """Return what the camera sees of each node under a light, (4913, 3) float64, counts; greys are neutral.

        A QualityError says that the print has no contrast under the light.
        """
        white = light.white(self.lut)
        means = np.zeros((NODES, 3))
        for number, weight in zip(light.lights, light.weights, strict=True):
            means += weight * self._lights(number)[0]
        over = means[_GREYS] / white
        level = over.mean(axis=1, keepdims=True)
        _require_contrast(self.lut, light.label, float(level[0, 0]), float(level[-1, 0]))
        factors = np.clip(level / np.maximum(over, 1e-9), 1 / MOST_TINT, MOST_TINT)
        low = np.minimum(self.map.levels.astype(np.int64), SIDE - 2)
        part = (self.map.levels - low)[:, None]
        return means * ((1 - part) * factors[low] + part * factors[low + 1])

    def black(self, light: Mixture) -> float:
        """Return what black is mapped to under a light, over its white."""
        return self._black(self.seen(light), light)

    def _black(self, seen: _Array, light: Mixture) -> float:
        return float((seen[0] / light.white(self.lut)).mean())

    def printed(self, light: Mixture, share: float = 0.0) -> PrintedLight:
        """Return what a light makes of the print, for `kernels.printing`.

        `share`: of the print's black that is taken out, 0 … 1; noise that would reach below 0 is then made smaller.
        """
        seen = self.seen(light)
        cells = np.stack([self._lights(number)[1] for number in light.lights])
        each = np.sqrt(self._variance(seen))
        means = np.empty((NODES, 4), np.float32)
        means[:, 3] = np.linalg.norm(each, axis=1)
        cells[:, :, 1, :3] /= means[:, 3, None]
        if share:
            veil = veil_of(self.lut, light, share, self._black(seen, light))
            seen = np.maximum((seen - veil.taken) * veil.stretch, 0.0)
            # Counts have no sign: noise that reached below 0 would be cut off there, and black be too bright.
            cells[:, :, 1, :3] *= veil.stretch * np.minimum(seen / (NOISE_ABOVE * each * veil.stretch), 1.0)
        means[:, :3] = seen
        return PrintedLight(means, cells, np.array(light.lights, np.int64), np.sqrt(light.weights).astype(np.float32))

    def draw(
        self,
        picture: npt.NDArray[np.uint8],
        mixtures: Sequence[Mixture],
        black_taken: float = 0.0,
        weights: npt.NDArray[np.float32] | None = None,
        **drawing: Any,
    ) -> npt.NDArray[np.uint16]:
        """Return the raw image (H, W, 3) of a picture (H, W, 3) under lights, or several by `weights` (H, W, K).

        `black_taken`: share of the print's black that is taken out, 0 … 1. `drawing`: keywords of
        `kernels.printing.draw_printed`.
        """
        lights = [self.printed(mixture, black_taken) for mixture in mixtures]
        return printing.draw_printed(self.lut.samples, picture, lights, self.cells, shares=weights, **drawing)

    def _variance(self, counts: _Array) -> _Array:
        """Return the variance of samples of so many counts (N, 3) in the mean; photon noise where it is not known."""
        kept = np.maximum(counts, 0.0)
        one, linear, square = self.map.noise if self.map.noise.any() else np.array([[0.0] * 3, [1.0] * 3, [0.0] * 3])
        return np.maximum(one + linear * kept + square * kept**2, 1e-6)


@lru_cache(maxsize=4)
def _rendering(lut: Lut, name: str, rows: tuple[float, ...], source: str) -> ColorimetricRendering:
    return ColorimetricRendering(lut, ColourMatrix(name, np.array(rows).reshape(3, 3), source))


def rendering_with(lut: Lut, matrix: ColourMatrix) -> ColorimetricRendering:
    """Return the rendering by colour with a table and a matrix; it keeps what it has found out of a table."""
    return _rendering(lut, matrix.name, tuple(matrix.rows.ravel().tolist()), matrix.source)
