"""Render by colour: print a picture through a profile of the chart, as a print shop does.

For a source colour, the camera should record a = C · linear sRGB, where C is the colour matrix of the camera body. The
black and the paper of a print are not ideal. Black is therefore mapped to the black point b of the print and white to
its white point w, as in black point compensation (ISO 18619:2015; there in XYZ, here in camera RGB): t = b + (w - b) a.

Nodes are 17 × 17 × 17 source colours (`kernels.printing.NODE_CODES`). Once per look-up table (LUT), `print_inverse`
calculates the position of each node: the three chart codes, usually not whole, at which the camera records t under a
reference illuminant. Like the profile of a printer, positions do not depend on the illuminant of an image. Under an
illuminant of the LUT, the value of a node is interpolated between the means of the patches around its position. Values
under several illuminants are added, because light is additive. A new illuminant takes a few milliseconds.

Greys of a print are tinted by some degrees if inks are not neutral, and the tint changes with the illuminant. Methods
and the eye judge an illuminant by greys, so greys are made neutral. Each grey is multiplied by a factor per channel
that keeps its brightness. Colours get the factor of the grey of equal brightness. `kernels/printing.py` adds the noise.
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
from generator.rendering.black_points import black_subtraction
from generator.rendering.matrices import ColourMatrix
from generator.rendering.print_inverse import corners, invert
from generator.rendering.print_profiles import PrintProfile, profile_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_Array = npt.NDArray[np.float64]

# Temperature of the reference illuminant, K: about the middle of daylight. Methods trained with positions for 5600 K
# were as accurate as with positions for each illuminant (docs/transfer.md).
REFERENCE_K: Final = 5600.0

# Smallest ratio of the darkest to the brightest channel of white under a reference illuminant. The illuminant must
# contain light of all channels.
_LEAST_RATIO: Final = 0.2

# A colour is in the gamut if target and print differ by at most this relative amount in each channel. It is 1/5 of the
# difference between neighbouring patches of a 5-bit chart.
GAMUT_TOLERANCE: Final = 0.02

# Largest angle of the black point to grey, degrees: slightly below the 0.5° allowed for greys.
BLACK_WITHIN_DEG: Final = 0.4

# Largest black point relative to the print's own black. Simulated unmanaged prints need 1.0 to 1.2; 1.25 reduces the
# contrast of a print by 0.01 of white.
MOST_LIFT: Final = 1.25

# Limit of the factors that make greys neutral. Prints need up to 1.1. In channels with very few counts, noise alone may
# cause larger factors.
MOST_TINT: Final = 1.5

# Limit of the factors that scale the deviations of the nearest patch to the expected noise of the node. Patch and node
# have different counts, and the standard deviation of 25 samples is uncertain by 1/7.
MOST_SPREAD: Final = 2.0

# After subtraction of black, noise is reduced until the mean is this many standard deviations above 0. Clipping at 0
# then raises the mean by 2 %.
NOISE_MARGIN: Final = 1.5

# Positions are rounded to 1/1024 of a patch, levels to 1/1024 of a grey node. Processors differ by far less.
_ROUNDING_STEPS: Final = 1024

_GREYS: Final = np.arange(SIDE) * (SIDE * SIDE + SIDE + 1)  # Nodes of three equal codes

_CACHED_LIGHTS: Final = 1024  # Illuminants of a LUT with nodes in memory, 200 kB each


def source_colours(matrix: ColourMatrix) -> _Array:
    """Return the target camera RGB of each node relative to white: clip(C · linear sRGB, 0, 1), (4913, 3) float64.

    `matrix`: linear sRGB to camera RGB with rows of sum 1, so that greys stay grey.
    """
    channel = decode_srgb(np.array(NODE_CODES) / 255)
    linear = np.stack(np.meshgrid(channel, channel, channel, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.clip(linear @ matrix.rows.T, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class PrintMap:
    """Positions of the nodes in a chart, and the properties of the print there.

    - `cells`: (U,) int64, indices of the patches that the nodes use.
    - `around`: (4913, 8) int64, indices in `cells` of the eight patches around the position of each node.
    - `weights`: (4913, 8) float64, weights of these patches, sum 1.
    - `nearest`: (4913,) int64, index in `cells` of the patch whose samples a node uses.
    - `levels`: (4913,) float64, 0 … 16: place of the grey of equal brightness among the 17 grey nodes.
    - `distance`: (4913,) float64, angle between the colour at the position and the target, degrees.
    - `outside`: (4913,) bool, whether the target is outside the gamut of the print; see `GAMUT_TOLERANCE`.
    - `noise`: (3, 3) float64, coefficients of 1, y and y² in the variance at y counts, one column per channel; 0 if the
      noise of the LUT cannot be measured.
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
        """Hash of the arrays that determine the pixels."""
        arrays = self.cells.astype("<i8"), self.around.astype("<i8"), self.weights.astype("<f8")
        arrays = *arrays, self.nearest.astype("<i8"), self.levels.astype("<f8"), self.noise.astype("<f8")
        return sha256_of(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays))

    def gamut_error(self, counts: npt.NDArray[np.int64]) -> tuple[float, float]:
        """Return the share of pixels outside the gamut of the print, 0 … 1, and the mean angle to the targets, degrees.

        `counts`: (4913,) int64, number of pixels nearest to each node, from `printing.count_by_node`.
        """
        shares = counts / counts.sum()
        return float(shares @ self.outside), float(shares @ self.distance)


_map_lock: Final = threading.Lock()  # Only one of several threads reads or computes a map

_MAP_FIELDS: Final = tuple(PrintMap.__dataclass_fields__)
_SUFFIX: Final = ".print"


def print_map(lut: Lut, matrix: ColourMatrix, folder: Path | None = None) -> PrintMap:
    """Return the map of the print of a LUT for a colour matrix, from the cache if possible.

    Unreadable cache files and failed writes are ignored, because the map takes only seconds to compute. `folder`: cache
    folder; None for `cache_folder`.
    """
    cache_key = {
        "table": lut.sha256,
        "matrix": [float(value).hex() for value in matrix.rows.ravel()],
        "code": _code_sha256(),
        "numpy": version("numpy"),
    }
    folder = folder or cache_folder()
    path = None if folder is None else folder / f"{sha256_of(json.dumps(cache_key).encode())}{_SUFFIX}"
    cached_map = _load(path)
    if cached_map is None:
        cached_map = compute_map(lut, matrix)
        _save(cached_map, path)
    return cached_map


def _load(path: Path | None) -> PrintMap | None:
    if path is None:
        return None
    with contextlib.suppress(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            cached_map = PrintMap(**{name: archive[name] for name in _MAP_FIELDS})
        if cached_map.around.shape == cached_map.weights.shape == (NODES, 8) and len(cached_map.nearest) == NODES:
            return cached_map
    return None


def _save(new_map: PrintMap, path: Path | None) -> None:
    if path is None:
        return
    stream = BytesIO()
    arrays: dict[str, Any] = {name: getattr(new_map, name) for name in _MAP_FIELDS}
    np.savez_compressed(stream, **arrays)
    # Several workers may save at the same time: each writes its own file, and the last one replaces the others.
    temporary_path = path.with_name(f"{path.stem}-{uuid.uuid4().hex}")
    with contextlib.suppress(CropError, OSError), atomic_file(temporary_path, lambda: path) as file:
        file.write(stream.getvalue())


@lru_cache(maxsize=1)
def _code_sha256() -> str:
    # Hash of the code that computes maps, so that maps of older code are not used.
    modules = [module.__name__ for module in (print_profiles, print_inverse, printing)]
    specs = [find_spec(name) for name in (*modules, "calibration.radiometry.table_noise", __name__)]
    files = [Path(str(spec.origin)) for spec in specs if spec is not None]
    return sha256_of(b"".join(file.read_bytes() for file in files))


def reference_light(lut: Lut) -> int:
    """Return the index of the reference illuminant for positions: the black body nearest to 5600 K.

    If the LUT has no black body with light in all channels, the illuminant with the most equal channels is returned.
    """
    ratio = lut.white.min(axis=1) / lut.white.max(axis=1)
    bodies = [
        (abs(1e6 / light.cct_k - 1e6 / REFERENCE_K), light.index)
        for light in lut.illuminations
        if light.cct_k is not None and ratio[light.index] >= _LEAST_RATIO
    ]
    return min(bodies)[1] if bodies else int(ratio.argmax())


def compute_map(lut: Lut, matrix: ColourMatrix) -> PrintMap:
    """Compute the map of the print of a LUT for a colour matrix; takes seconds.

    Raises QualityError if no patch is usable or the print has no contrast.
    """
    light, bits = reference_light(lut), lut.provenance.bits
    profile = profile_of(lut, light)
    _require_contrast(lut, light, profile.black, profile.white)
    usable = profile.usable & _usable_elsewhere(lut, light)
    if not usable.any():
        usable = profile.usable
    colours = _filled(profile.colours, usable, bits)
    black = black_point(profile, colours, bits)
    source = source_colours(matrix)
    targets = black + (profile.white - black) * source
    # The last digits differ between processors and libraries. Rounding makes pixels equal on all of them.
    positions = _rounded(invert(colours, targets, bits))
    around, weights = corners(positions, bits)
    weights = weights * usable[around]
    sums = weights.sum(axis=1)
    nearest = _nearest(positions, np.flatnonzero(usable), bits)
    lacks_patches = sums < 1e-6
    weights[lacks_patches], around[lacks_patches] = np.eye(8)[0], nearest[lacks_patches, None]
    weights[~lacks_patches] /= sums[~lacks_patches, None]
    shown_colours = np.einsum("kc,kcx->kx", weights, profile.colours[around])
    cells, cell_positions = np.unique(np.concatenate([around.ravel(), nearest]), return_inverse=True)
    brightness = np.asarray(source.mean(axis=1), np.float64)
    levels = _rounded(np.asarray(np.interp(brightness, brightness[_GREYS], np.arange(SIDE)), np.float64))
    return PrintMap(
        cells,
        cell_positions[: NODES * 8].reshape(NODES, 8),
        weights,
        cell_positions[NODES * 8 :],
        levels,
        angles_deg(shown_colours, targets),
        np.asarray((np.abs(shown_colours - targets) > GAMUT_TOLERANCE * targets).any(axis=1)),
        _noise_of(lut),
    )


def _rounded(numbers: _Array) -> _Array:
    return np.round(numbers * _ROUNDING_STEPS) / _ROUNDING_STEPS


def _require_contrast(lut: Lut, light: int | str, black: float, white: float) -> None:
    if 2 * black >= white:
        raise QualityError(
            f"under illuminant {light} the LUT {lut.folder} has a black of {black:.2g} × white, expected less than "
            "half of its paper: the black patch is spoilt or the print has no contrast; leave the illuminant out, "
            "build the LUT again, or render by codes (--rendering codes)"
        )


def _usable_elsewhere(lut: Lut, reference: int) -> npt.NDArray[np.bool_]:
    # Hot photosites are most visible under the illuminants that are darkest in a channel. Patches that are unreliable
    # under these illuminants are excluded.
    darkest_lights = {int(light) for light in lut.white.argmin(axis=0)} - {reference}
    usable = np.ones(8**lut.provenance.bits, bool)
    for light in darkest_lights:
        with contextlib.suppress(QualityError):
            usable &= profile_of(lut, light).usable
    return usable


def _filled(colours: _Array, usable: npt.NDArray[np.bool_], bits: int) -> _Array:
    unusable_cells, usable_cells = np.flatnonzero(~usable), np.flatnonzero(usable)
    filled = colours.copy()
    if len(unusable_cells):
        filled[unusable_cells] = colours[_nearest(channels_of(unusable_cells, bits), usable_cells, bits)]
    return filled


def _nearest(positions: npt.NDArray[Any], cells: npt.NDArray[np.int64], bits: int) -> npt.NDArray[np.int64]:
    from scipy.spatial import KDTree

    tree: Any = KDTree(channels_of(cells, bits))
    return cells[np.asarray(tree.query(positions)[1], np.int64)]


def black_point(profile: PrintProfile, colours: _Array, bits: int) -> float:
    """Return the grey to which black is mapped, 1 = ideal white.

    Candidates are 1 to 1.25 times the print's own black. The darkest candidate that the print shows within
    `BLACK_WITHIN_DEG` of grey is used; if there is none, the print's own black. `colours`: (8**bits, 3) float64,
    colours of the profile, with replacements for unusable patches.
    """
    levels = profile.black * np.linspace(1.0, MOST_LIFT, 26)
    levels = levels[levels <= profile.white]
    targets = levels[:, None] * np.ones(3)
    around, weights = corners(invert(colours, targets, bits), bits)
    is_neutral = angles_deg(np.einsum("kc,kcx->kx", weights, colours[around]), targets) <= BLACK_WITHIN_DEG
    return float(levels[int(is_neutral.argmax())])


def _noise_of(lut: Lut) -> _Array:
    # Coefficients of 1, y and y² in the variance at y counts. The import is here because it loads scipy and cv2.
    from calibration.radiometry.table_noise import noise_curve

    with contextlib.suppress(InputError):
        curve = noise_curve(lut)
        if curve is not None:
            terms = np.stack([curve.read_noise**2, 1 / curve.gain_e, curve.response**2])
            return np.array([[float(f"{term:.6g}") for term in row] for row in terms.tolist()])
    return np.zeros((3, 3))


@dataclass(frozen=True, eq=False)
class ColorimetricRendering:
    """Rendering by colour with one LUT.

    `matrix`: linear sRGB to camera RGB. `folder`: cache folder of the print map; None for `cache_folder`.
    """

    lut: Lut
    matrix: ColourMatrix
    folder: Path | None = None

    @cached_property
    def map(self) -> PrintMap:
        """Positions of source colours in the chart."""
        with _map_lock:
            return print_map(self.lut, self.matrix, self.folder)

    @cached_property
    def cells(self) -> npt.NDArray[np.uint32]:
        """(4913,) uint32, patch whose samples each node uses."""
        return self.map.cells[self.map.nearest].astype(np.uint32)

    @cached_property
    def _cached_nodes_of(self) -> Any:
        return lru_cache(maxsize=_CACHED_LIGHTS)(self._nodes_of)

    def _nodes_of(self, light: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return the mean counts of the nodes (4913, 3) under an illuminant of the LUT, and values (4913, 2, 4).

        Values [:, 0] are the mean counts of the nearest patches. Values [:, 1] are the factors that scale their
        deviations to the noise of the LUT at the node. The fourth column is unused.
        """
        chart, samples = self.map, np.asarray(self.lut.light_samples(light))
        means, spreads, cell_values = np.empty((NODES, 3)), np.empty((NODES, 3)), np.zeros((NODES, 2, 4), np.float32)
        cell_means = np.empty((NODES, 3))
        means_at(samples, chart.around, chart.weights, chart.nearest, chart.cells, means, cell_means, spreads)
        cell_values[:, 0, :3], cell_values[:, 1, :3] = cell_means, 1.0
        if chart.noise.any():
            factors = np.sqrt(self._variance(means) / np.maximum(spreads, 1e-6))
            cell_values[:, 1, :3] = np.where(spreads > 0, np.clip(factors, 1 / MOST_SPREAD, MOST_SPREAD), 0.0)
        return means.astype(np.float32), cell_values

    def node_means(self, light: Mixture) -> _Array:
        """Return the counts of each node under an illuminant, (4913, 3) float64; greys are neutral.

        Raises QualityError if the print has no contrast under the illuminant.
        """
        white = light.white(self.lut)
        means = np.zeros((NODES, 3))
        for number, weight in zip(light.lights, light.weights, strict=True):
            means += weight * self._cached_nodes_of(number)[0]
        relative = means[_GREYS] / white
        brightness = relative.mean(axis=1, keepdims=True)
        _require_contrast(self.lut, light.label, float(brightness[0, 0]), float(brightness[-1, 0]))
        factors = np.clip(brightness / np.maximum(relative, 1e-9), 1 / MOST_TINT, MOST_TINT)
        low = np.minimum(self.map.levels.astype(np.int64), SIDE - 2)
        fraction = (self.map.levels - low)[:, None]
        return means * ((1 - fraction) * factors[low] + fraction * factors[low + 1])

    def black(self, light: Mixture) -> float:
        """Return the grey to which black is mapped under an illuminant, relative to its white."""
        return self._black(self.node_means(light), light)

    def _black(self, node_means: _Array, light: Mixture) -> float:
        return float((node_means[0] / light.white(self.lut)).mean())

    def printed_light(self, light: Mixture, share: float = 0.0) -> PrintedLight:
        """Return the print under an illuminant, for `kernels.printing`.

        `share`: share of the print's black that is subtracted, 0 … 1. Noise that would reach below 0 is then reduced.
        """
        nodes = self.node_means(light)
        cells = np.stack([self._cached_nodes_of(number)[1] for number in light.lights])
        sigmas = np.sqrt(self._variance(nodes))
        means = np.empty((NODES, 4), np.float32)
        means[:, 3] = np.linalg.norm(sigmas, axis=1)
        cells[:, :, 1, :3] /= means[:, 3, None]
        if share:
            removal = black_subtraction(self.lut, light, share, self._black(nodes, light))
            nodes = np.maximum((nodes - removal.counts) * removal.stretch, 0.0)
            # Counts have no sign. Clipping the noise below 0 would make black too bright.
            cells[:, :, 1, :3] *= removal.stretch * np.minimum(nodes / (NOISE_MARGIN * sigmas * removal.stretch), 1.0)
        means[:, :3] = nodes
        return PrintedLight(means, cells, np.array(light.lights, np.int64), np.sqrt(light.weights).astype(np.float32))

    def draw(
        self,
        picture: npt.NDArray[np.uint8],
        mixtures: Sequence[Mixture],
        black_share: float = 0.0,
        weights: npt.NDArray[np.float32] | None = None,
        **options: Any,
    ) -> npt.NDArray[np.uint16]:
        """Return the raw image (H, W, 3) of a picture under one illuminant, or several with `weights` (H, W, K).

        `black_share`: share of the print's black that is subtracted, 0 … 1. `options`: keywords of
        `kernels.printing.draw_printed`.
        """
        lights = [self.printed_light(mixture, black_share) for mixture in mixtures]
        return printing.draw_printed(self.lut.samples, picture, lights, self.cells, shares=weights, **options)

    def _variance(self, counts: _Array) -> _Array:
        # Variance of samples with these mean counts (N, 3); photon noise if the noise of the LUT is unknown.
        clipped = np.maximum(counts, 0.0)
        read, shot, square = self.map.noise if self.map.noise.any() else np.array([[0.0] * 3, [1.0] * 3, [0.0] * 3])
        return np.maximum(read + shot * clipped + square * clipped**2, 1e-6)


@lru_cache(maxsize=4)
def _rendering(lut: Lut, name: str, rows: tuple[float, ...], source: str) -> ColorimetricRendering:
    return ColorimetricRendering(lut, ColourMatrix(name, np.array(rows).reshape(3, 3), source))


def rendering_with(lut: Lut, matrix: ColourMatrix) -> ColorimetricRendering:
    """Return the rendering by colour with a LUT and a matrix; results for the same LUT are cached."""
    return _rendering(lut, matrix.name, tuple(matrix.rows.ravel().tolist()), matrix.source)
