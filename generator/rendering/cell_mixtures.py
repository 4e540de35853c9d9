"""Which cells of the chart together show a wanted colour: 16 of them, equally likely, for each wanted colour.

For a wanted colour t the weights w of the cells near to it are to make their mean t, and their spread small::

    minimise  |m - t|² + λ Σ w |R - t|²,   m = Σ w R,  w ≥ 0,  Σ w = 1,

R being what the camera sees of a cell. Weights are whole 16ths from the start, since a pixel takes one of 16 cells:
from all 16 on the nearest cell, one 16th at a time moves from a cell to another, each time by the move that lowers the
sum most, until none does (an exchange algorithm, V. V. Fedorov, *Theory of Optimal Experiments*, 1972, chapter 3). It
is as good as rounding the weights that are best as real numbers, and needs no solver for those. Where no single move
helps, two at once may: greys, on which the eye and the field's errors turn, are tried so, too.

Differences are relative to t, channel by channel, and those of brightness count less than those of chromaticity: the
field measures lights by angles, and where the print cannot show a colour, its hue is to stay rather than its
brightness.

Mixtures are kept in the user's folder for such things. A file is named after all that its content depends on: the
table, the light, the matrix, and the code that computed it. It holds its own hash. A file that is damaged, of another
kind, or unreadable is as good as none, and where nothing can be written nothing is kept: a second of work is no reason
to fail. Whoever wants the room may delete the folder.
"""

from __future__ import annotations

import contextlib
import uuid
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg
from foundation.compiled import compiled
from foundation.errors import CropError
from foundation.files import cache_folder, sha256_of, whole_file
from generator.rendering.print_profiles import PrintProfile

SLOTS: Final = 16
"""Cells of a mixture: twice as many miss greys by .01° to .03° less, but fill the cache twice over, and are slower."""

NEIGHBOURS: Final = 24
"""Cells near to a wanted colour that are mixed: they surround it, except at the edge of what the print can show."""

WIDE_NEIGHBOURS: Final = 384
"""The same where the nearest do not surround a colour near grey."""

SPREAD_COST: Final = 0.03
"""λ: what a mixture's spread costs against its error. Between 0.1 and 0.001 errors hardly differ, and the spread by a
fifth: docs/reference/rendering.md."""

WIDE_SPREAD_COST: Final = 0.003
"""The same for colours near grey that are not met with the nearest cells; their chromaticity matters most."""

BRIGHTNESS_COST: Final = 0.5
"""What a relative difference of brightness counts against one of chromaticity. Chosen: see
docs/reference/rendering.md."""

MET_WITHIN: Final = 0.02
"""Largest relative difference in a channel of a mixture that shows the wanted colour: a fifth of what neighbouring
cells of a chart of five bits differ."""

NEAR_GREY_DEG: Final = 6.0
"""Angle to grey below which a colour is near grey: greys of a picture are shared out among nodes as far as that."""

GREY_WITHIN_DEG: Final = 0.2
"""Angle to a wanted colour near grey from which more cells are tried."""

GREY_MET_DEG: Final = 0.05
"""Angle to grey from which two cells of a grey's mixture are exchanged at once: a tenth of what greys may be off."""

PAIR_NEIGHBOURS: Final = 192
"""Cells tried when two are exchanged at once: all pairs of moves to them take some ten milliseconds a grey. Greys that
are then still off by `GREY_WITHIN_DEG`, dark ones most of all, are tried with `WIDE_NEIGHBOURS`."""

_Array = npt.NDArray[np.float64]

_GREY_SPREAD: Final = 1e-6
"""Relative difference of channels up to which a wanted colour is a grey: rounding of the colour matrix leaves 1e-16."""

_AXES: Final = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]]) / np.sqrt([[3.0], [2.0], [6.0]])
"""Brightness and two directions of chromaticity, of length 1, for relative or logarithmic differences of channels."""


@dataclass(frozen=True, eq=False)
class CellMixtures:
    """For each of K wanted colours 16 equally likely cells whose mean shows it.

    - `cells`: (K, 16) uint16, numbers of cells of the chart, ((r << 2n) | (g << n) | b) for n bits a channel;
      ascending.
    - `colours`: (K, 3) float32, what the camera sees of the 16 in the mean, over the white of the light.
    - `wanted`: (K, 3) float32, what it should see.
    """

    cells: npt.NDArray[np.uint16]
    colours: npt.NDArray[np.float32]
    wanted: npt.NDArray[np.float32]

    @property
    def black(self) -> float:
        """What black, the first wanted colour, was mapped to: the mean of its channels, over the white of the light."""
        return float(self.wanted[0].mean(dtype=np.float64))

    @cached_property
    def distance(self) -> npt.NDArray[np.float32]:
        """(K,) float32, angle between the mean of the 16 and the wanted colour, degrees."""
        return angles_deg(self.colours, self.wanted).astype(np.float32)

    @cached_property
    def outside(self) -> npt.NDArray[np.bool_]:
        """(K,) bool, whether cells near to a colour cannot show it: the mean is off by more than `MET_WITHIN`."""
        return np.asarray((np.abs(self.colours - self.wanted) > MET_WITHIN * self.wanted).any(axis=1))


def mix_cells(profile: PrintProfile, wanted: _Array) -> CellMixtures:
    """Return for each wanted colour the cells that together show it.

    `wanted`: (K, 3) float64 > 0, what the camera should see, over the white of the light.

    Examples
    --------
    >>> ramp = np.stack([np.full(8, 0.5), np.full(8, 0.5), np.linspace(0.2, 0.9, 8)], axis=-1)
    >>> mixtures = mix_cells(PrintProfile(ramp, np.ones(8, bool)), np.array([[0.5, 0.5, 0.525]]))
    >>> int(mixtures.cells.min()), int(mixtures.cells.max()), bool(mixtures.outside[0])
    (3, 4, False)
    >>> [round(float(seen), 3) for seen in mixtures.colours[0]]
    [0.5, 0.5, 0.525]
    """
    from scipy.spatial import KDTree

    usable = np.flatnonzero(profile.usable)
    colours = profile.colours[usable]
    scale = np.array([[BRIGHTNESS_COST**0.5], [1.0], [1.0]]) * _AXES
    tree: Any = KDTree(np.log(colours) @ scale.T)
    places = np.log(wanted) @ scale.T

    def chosen(of: npt.NDArray[np.int64], neighbours: int, cost: float) -> npt.NDArray[np.int64]:
        out = np.empty((len(of), SLOTS), np.int64)
        _exchange(colours, wanted[of], scale, nearest(of, neighbours), cost, out)
        return out

    def nearest(of: npt.NDArray[np.int64], neighbours: int) -> npt.NDArray[np.int64]:
        near: Any = tree.query(places[of], k=np.arange(1, min(neighbours, len(usable)) + 1))[1]
        return np.ascontiguousarray(near, dtype=np.int64)

    cells = chosen(np.arange(len(wanted)), NEIGHBOURS, SPREAD_COST)
    missed = angles_deg(colours[cells].mean(axis=1), wanted) > GREY_WITHIN_DEG
    again = np.flatnonzero(missed & near_grey(wanted))
    if len(again):
        cells[again] = chosen(again, WIDE_NEIGHBOURS, WIDE_SPREAD_COST)
    is_grey = np.ptp(wanted, axis=1) <= _GREY_SPREAD * wanted.max(axis=1)
    for neighbours, met in ((PAIR_NEIGHBOURS, GREY_MET_DEG), (WIDE_NEIGHBOURS, GREY_WITHIN_DEG)):
        off = angles_deg(colours[cells].mean(axis=1), np.ones(3)) > met
        greys = np.flatnonzero(off & is_grey)
        if len(greys):
            improved = np.ascontiguousarray(cells[greys])
            near = nearest(greys, neighbours)
            _exchange_pairs(colours, wanted[greys], scale, near, WIDE_SPREAD_COST, improved)
            cells[greys] = improved
    return mixtures_of(np.sort(usable[cells], axis=1).astype(np.uint16), profile, wanted)


def mixtures_of(cells: npt.NDArray[np.uint16], profile: PrintProfile, wanted: _Array) -> CellMixtures:
    """Return mixtures of cells that were chosen, with what the camera sees of them.

    `cells`: (K, 16) uint16, numbers of cells. `wanted`: (K, 3) float64 > 0, what the camera should see, over the white
    of the light.
    """
    made = profile.colours[cells].mean(axis=1)
    return CellMixtures(cells, made.astype(np.float32), wanted.astype(np.float32))


def near_grey(colours: _Array) -> npt.NDArray[np.bool_]:
    """Return (K,) bool, which of (K, 3) float64 colours over white are within `NEAR_GREY_DEG` of grey.

    Examples
    --------
    >>> near_grey(np.array([[0.5, 0.5, 0.55], [0.5, 0.2, 0.2]])).tolist()
    [True, False]
    """
    return np.asarray(angles_deg(colours, np.ones(3)) < NEAR_GREY_DEG)


@compiled
def _place(colour: Any, wanted: Any, scale: Any, place: Any) -> float:
    """Write where a colour lies from the wanted one, by what differences cost, into `place` (3,); return its square."""
    square = 0.0
    for axis in range(3):
        place[axis] = 0.0
        for channel in range(3):
            place[axis] += scale[axis, channel] * (colour[channel] / wanted[channel] - 1.0)
        square += place[axis] * place[axis]
    return square


@compiled
def _exchange(colours: Any, wanted: Any, scale: Any, near: Any, cost: float, out: Any) -> None:
    """Write into `out` (K, 16) the cells of `near` (K, M) for each wanted colour (K, 3); see the head of this file.

    `scale` (3, 3) leads from relative differences of channels to what they cost.
    """
    candidates = near.shape[1]
    slots = out.shape[1]
    places = np.empty((candidates, 3))
    single = np.empty(candidates)
    counts = np.zeros(candidates, np.int64)
    total = np.empty(3)
    for k in range(len(wanted)):
        nearest = 0
        for j in range(candidates):
            # In units of the square of a sum of all slots, as what follows is.
            single[j] = cost * slots * _place(colours[near[k, j]], wanted[k], scale, places[j])
            if single[j] < single[nearest]:
                nearest = j
        counts[:] = 0
        counts[nearest] = slots
        for axis in range(3):
            total[axis] = slots * places[nearest, axis]
        while True:
            best, source, sink = -1e-12, -1, -1
            for i in range(candidates):
                if counts[i] == 0:
                    continue
                for j in range(candidates):
                    change = single[j] - single[i]
                    for axis in range(3):
                        step = places[j, axis] - places[i, axis]
                        change += step * (2.0 * total[axis] + step)
                    if change < best:
                        best, source, sink = change, i, j
            if source < 0:
                break
            counts[source] -= 1
            counts[sink] += 1
            for axis in range(3):
                total[axis] += places[sink, axis] - places[source, axis]
        slot = 0
        for j in range(candidates):
            for _ in range(counts[j]):
                out[k, slot] = near[k, j]
                slot += 1


@compiled
def _exchange_pairs(colours: Any, wanted: Any, scale: Any, near: Any, cost: float, cells: Any) -> None:
    """Exchange two of the cells (K, 16) of each wanted colour (K, 3) for two of `near` (K, M), while that helps."""
    candidates = near.shape[1]
    slots = cells.shape[1]
    places = np.empty((candidates, 3))
    single = np.empty(candidates)
    held = np.empty((slots, 3))
    held_single = np.empty(slots)
    total = np.empty(3)
    tried = np.empty((slots * slots, 2), np.int64)
    for k in range(len(wanted)):
        for j in range(candidates):
            single[j] = _place(colours[near[k, j]], wanted[k], scale, places[j]) * cost * slots
        total[:] = 0.0
        for i in range(slots):
            held_single[i] = _place(colours[cells[k, i]], wanted[k], scale, held[i]) * cost * slots
            total += held[i]
        while True:
            best, first, second, one, other = -1e-12, -1, -1, -1, -1
            pairs = 0
            for i in range(slots):
                for i2 in range(i):
                    # Of 16 slots some six are distinct, and equal pairs are equally good.
                    known = False
                    for pair in range(pairs):
                        if tried[pair, 0] == cells[k, i] and tried[pair, 1] == cells[k, i2]:
                            known = True
                    if known:
                        continue
                    tried[pairs, 0], tried[pairs, 1] = cells[k, i], cells[k, i2]
                    pairs += 1
                    x = total[0] - held[i, 0] - held[i2, 0]
                    y = total[1] - held[i, 1] - held[i2, 1]
                    z = total[2] - held[i, 2] - held[i2, 2]
                    before = held_single[i] + held_single[i2]
                    before += total[0] * total[0] + total[1] * total[1] + total[2] * total[2]
                    for j in range(candidates):
                        xj, yj, zj = x + places[j, 0], y + places[j, 1], z + places[j, 2]
                        gain = single[j] - before
                        for j2 in range(j + 1):
                            xe, ye, ze = xj + places[j2, 0], yj + places[j2, 1], zj + places[j2, 2]
                            change = gain + single[j2] + xe * xe + ye * ye + ze * ze
                            if change < best:
                                best, first, second, one, other = change, i, i2, j, j2
            if first < 0:
                break
            for slot, choice in ((first, one), (second, other)):
                total += places[choice] - held[slot]
                held[slot] = places[choice]
                held_single[slot] = single[choice]
                cells[k, slot] = near[k, choice]


_MAGIC: Final = b"CroP cell mixtures 1\n"
"""First bytes of a file."""

_DIGEST: Final = 64
"""Bytes of the hash in hexadecimal digits that follow them (FIPS 180-4)."""

_SUFFIX: Final = ".mixtures"

_LEVEL: Final = 1
"""Of zlib: a file becomes a quarter, in a twentieth of a second; higher levels gain a tenth and take a second."""

MOST_BYTES: Final = 1 << 30
"""Room that kept mixtures may take, bytes: those of all 707 lights of a table with one matrix and more."""


def load_mixtures(key: str, nodes: int, folder: Path | None = None) -> CellMixtures | None:
    """Return mixtures that were kept, or None if there are none or they are damaged.

    `folder`: where they lie; None for `cache_folder`.
    """
    folder = folder or cache_folder()
    if folder is None:
        return None
    try:
        content = (folder / f"{key}{_SUFFIX}").read_bytes()
    except OSError:
        return None
    head, payload = content[: len(_MAGIC) + _DIGEST], content[len(_MAGIC) + _DIGEST :]
    if head != _head(payload):
        return None
    # What has its own hash was written by `keep_mixtures`, so it can be decompressed.
    plain = zlib.decompress(payload)
    sizes = [nodes * SLOTS * 2, nodes * 3 * 4, nodes * 3 * 4]
    if len(plain) != sum(sizes):
        return None
    steps, colours, wanted = (
        np.frombuffer(plain, kind, count=size // np.dtype(kind).itemsize, offset=sum(sizes[:part]))
        for part, (kind, size) in enumerate(zip(("<u2", "<f4", "<f4"), sizes, strict=True))
    )
    cells = np.cumsum(steps.reshape(SLOTS, nodes), axis=0, dtype=np.uint16).T
    return CellMixtures(np.ascontiguousarray(cells), _rows(colours), _rows(wanted))


def are_kept(key: str, folder: Path | None = None) -> bool:
    """Return whether there is a file of such mixtures, whatever its state; arguments as of `load_mixtures`."""
    folder = folder or cache_folder()
    return folder is not None and (folder / f"{key}{_SUFFIX}").is_file()


def keep_mixtures(key: str, mixtures: CellMixtures, folder: Path | None = None) -> None:
    """Keep mixtures for the next time; does nothing where that cannot be.

    Where all that is kept takes more than `MOST_BYTES`, what was written first is removed.

    `folder`: where to; None for `cache_folder`.
    """
    folder = folder or cache_folder()
    if folder is None:
        return
    # Cells ascend: steps from one to the next are mostly 0.
    steps = np.diff(mixtures.cells.T, axis=0, prepend=np.uint16(0)).astype("<u2")
    arrays = steps, mixtures.colours.astype("<f4"), mixtures.wanted.astype("<f4")
    payload = zlib.compress(b"".join(array.tobytes() for array in arrays), _LEVEL)
    path = folder / f"{key}{_SUFFIX}"
    # Workers may come here at the same time: each writes a file of its own, and the last to finish names it.
    own = path.with_name(f"{key}-{uuid.uuid4().hex}")
    with contextlib.suppress(CropError, OSError):
        with whole_file(own, lambda: path) as stream:
            stream.write(_head(payload) + payload)
        _make_room(folder)


def _make_room(folder: Path) -> None:
    """Remove what was written first until the rest takes no more than `MOST_BYTES`."""
    files = [(path.stat(), path) for path in folder.glob(f"*{_SUFFIX}")]
    total = sum(status.st_size for status, _ in files)
    for status, path in sorted(files, key=lambda file: (file[0].st_mtime_ns, file[1].name)):
        if total <= MOST_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= status.st_size


def _rows(numbers: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return numbers.reshape(-1, 3).astype(np.float32)


def _head(payload: bytes) -> bytes:
    return _MAGIC + sha256_of(payload).encode()


@dataclass(frozen=True)
class GamutSummary:
    """What a print makes of the colours of a picture.

    - `outside`: share of the pixels whose colour cells near to it cannot show, 0 … 1.
    - `distance_deg`: mean angle between what the cells show and what the camera should see, degrees, over all pixels.
    """

    outside: float
    distance_deg: float


def summarise(mixtures: CellMixtures, shares: npt.NDArray[np.float64]) -> GamutSummary:
    """Return what a print makes of a picture.

    Parameters
    ----------
    mixtures
        Of the light of the image: 32768.
    shares
        (32768,) float64 ≥ 0, how often each source node occurs, as from
        `dithering.nearest_nodes`; of any sum above 0.

    Examples
    --------
    >>> cells, seen = np.zeros((32768, 16), np.uint16), np.full((32768, 3), 0.5, np.float32)
    >>> wanted = seen.copy()
    >>> wanted[32767] = 1, 0.5, 0.5
    >>> shares = np.zeros(32768)
    >>> shares[[0, 32767]] = 3, 1
    >>> summary = summarise(CellMixtures(cells, seen, wanted), shares)
    >>> summary.outside, round(summary.distance_deg, 3)
    (0.25, 4.868)
    """
    weights = shares / shares.sum()
    return GamutSummary(float(weights @ mixtures.outside), float(weights @ mixtures.distance))
