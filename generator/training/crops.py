"""Training batches: crops of pictures under lights drawn afresh, with the ground truth of each.

`Crops` is the endless set of items a table and a gallery allow. Which picture, window, light, mirror image, gain and
samples item i of an epoch has is a pure function of (seed, epoch, i): the words of Philox4x32-10 with counter
(i, epoch, k, 7), k = 0 picture, column, row, light; k = 1 mirror, gain and the share of the print's black that is taken
out; k = 2 the kernel's seed. So the items are the same however many workers share them.

Needs no PyTorch; `torch_crops` has the data sets that do::

    from torch.utils.data import DataLoader
    from generator.training import Crops, open_gallery
    from generator.training.torch_crops import CropDataset, collated

    crops = Crops(lut, open_gallery("gallery"), (128, 128), length=100_000, exposure=(0.5, 2.0))
    for batch in DataLoader(CropDataset(crops), batch_size=64, shuffle=True, num_workers=2, collate_fn=collated):
        batch["image"]          # (64, 3, 128, 128) float32, linear camera RGB, 1 = saturation
        batch["illuminant"]     # (64, 3) float32, r + g + b = 1
"""

from __future__ import annotations

import contextlib
import mmap
import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, get_args

import numpy as np
import numpy.typing as npt

from calibration.table.lut import open_lut, require_lut
from foundation.errors import InputError, value_text
from generator import philox
from generator.kernels.planar import draw_batch, scales_of
from generator.kernels.printed_crops import draw_printed_crops
from generator.kernels.printing import PrintedLight
from generator.kernels.unfit import replace_unfit_colours
from generator.lights.choices import light_of
from generator.lights.lighting import Mixture
from generator.rendering import DEFAULT, Rendering
from generator.rendering.black_points import KEEP, BlackPoint, parse_black_point, veil_of
from generator.rendering.colorimetric import ColorimetricRendering
from generator.rendering.matrices import matrix_for
from generator.training.gallery import Gallery
from generator.variation.exposing import add_noise

if TYPE_CHECKING:
    from pathlib import Path

    from calibration.table.lut import Lut
    from generator.rendering.matrices import ColourMatrix
    from generator.variation.iso_speed import IsoSpeed
    from generator.variation.sensor_noise import SensorNoise


KEPT: Final = 2  # Pieces of memory that are kept for later: a loop still refers to one batch while it gets the next


class Recycled:
    """Makes large arrays in memory that is used again: the system clears each page that a program has not had before.

    Clearing takes half as long as the drawing of a batch. An array gives its memory back when it and all views of it
    are gone; memory to which a view still refers is never used again. Threads may share it.
    """

    def __init__(self) -> None:
        self._free: deque[mmap.mmap] = deque(maxlen=KEPT)

    def array(self, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
        """Return an array float32 of any content.

        Returns (...) float32, C order.
        """
        size = 4 * int(np.prod(shape))
        memory = self._memory(size)
        # Views refer to `values`, since what is below it is no array; so it lives as long as the last of them.
        values = np.frombuffer(memory, dtype=np.float32)
        weakref.finalize(values, self._free.append, memory).atexit = False
        return values.reshape(shape)

    def _memory(self, size: int) -> mmap.mmap:
        with contextlib.suppress(IndexError):
            while len(memory := self._free.pop()) != size:
                pass
            return memory
        memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        # Large pages where the system has them: a five-hundredth of the faults.
        if hasattr(mmap, "MADV_HUGEPAGE"):
            memory.madvise(mmap.MADV_HUGEPAGE)
        return memory


_HALF: Final = np.uint64(32)  # Bits of a random word


@dataclass(frozen=True, eq=False)
class Batch:
    """N items.

    Attributes
    ----------
    images
        (N, 3, height, width) float32, linear camera RGB, 0 … 1 = saturation of the sensor. Where the print's black is
        taken out, noise reaches below 0, some thousandths: cut off there, black would be too bright. Whoever takes
        logarithms or roots has to do it.
    illuminants
        (N, 3) float32, the ground truth, r + g + b = 1.
    lights
        (N,) int64, place of each item's light in `Crops.lights`.
    pictures
        (N,) int64, place of each item's picture in the gallery.
    black_taken
        (N,) float64, share of the print's black that was taken out, 0 … 1.

    Examples
    --------
    >>> from generator import open_lut, read_picture
    >>> from generator.training import gallery_of
    >>> crops = Crops(open_lut("lut"), gallery_of([read_picture("cat.png")]), (8, 8), lights=[3])
    >>> batch = crops.batch([0])
    >>> batch.lights, batch.pictures, batch.illuminants.sum(axis=1)
    (array([0]), array([0]), array([1.], dtype=float32))
    """

    images: npt.NDArray[np.float32]
    illuminants: npt.NDArray[np.float32]
    lights: npt.NDArray[np.int64]
    pictures: npt.NDArray[np.int64]
    black_taken: npt.NDArray[np.float64]


class Crops:
    """Crops of a gallery's pictures under a table's lights.

    Parameters
    ----------
    lut
        The table.
    gallery
        The pictures; see `gallery`. Every one must be as large as a crop. Where the table lists colours as unfit,
        pictures that have them are copied to memory with the nearest fit ones instead.
    size
        Height and width of a crop, px.
    length
        Items of an epoch.
    lights
        What lights to draw from, each as likely: numbers of the table's lights, texts as the command's ``--light``
        takes them, such as ``"D65"`` or ``"5600K"``, or mixtures. What is no single light of the table takes 5 MB of
        memory each. None: all lights of the table.
    exposure
        Least and largest gain, > 0; drawn evenly in stops. What a gain above 1 takes past saturation is cut off there.
    noise
        Of the table's samples, `generator.variation.sensor_noise.measured_noise(lut)`: items of a gain below 1 are
        then as noisy as a camera is in so much less light. None scales samples alone, noise included.
    iso
        ISO speed whose noise items have; needs `noise`. None for the table's. A gain above it is noisier.
    flip
        Whether half of the items are mirrored.
    seed
        0 … 2⁶⁴ − 1.
    epoch
        0 … 2³² − 1; see `at_epoch`.
    threads
        Threads that share a batch; no value depends on it.
    rendering
        ``"colorimetric"``: the print shows the picture's colours to the camera. Where in the chart they are takes
        seconds a table, once: it lies in the user's cache folder then. Each light takes half a megabyte of memory.
        ``"codes"``: a picture's codes are those of the print, as in the paper.
    matrix
        Linear sRGB to the camera's RGB, for colorimetric rendering; None for that of the table's camera.
    black_point
        What becomes of the print's black; a text as the command's ``--black-point`` takes it, such as ``"random"``.

    Raises
    ------
    InputError
        A number is out of range, a light is not in the table, or a picture is smaller than a crop.

    Examples
    --------
    >>> from generator import open_lut, read_picture
    >>> from generator.training import gallery_of
    >>> crops = Crops(open_lut("lut"), gallery_of([read_picture("cat.png")]), (16, 24), length=100, seed=1)
    >>> batch = crops.batch([0, 99])
    >>> batch.images.shape, batch.images.dtype, batch.illuminants.shape
    ((2, 3, 16, 24), dtype('float32'), (2, 3))
    """

    def __init__(
        self,
        lut: Lut,
        gallery: Gallery,
        size: tuple[int, int] = (128, 128),
        *,
        length: int = 1 << 20,
        lights: Sequence[int | str | Mixture] | None = None,
        exposure: tuple[float, float] = (1.0, 1.0),
        noise: SensorNoise | None = None,
        iso: IsoSpeed | None = None,
        flip: bool = True,
        seed: int = 0,
        epoch: int = 0,
        threads: int = 1,
        rendering: Rendering = DEFAULT,
        matrix: ColourMatrix | None = None,
        black_point: BlackPoint | str = KEEP,
    ) -> None:
        require_lut(lut)
        if isinstance(black_point, str):
            black_point = parse_black_point(black_point)
        _require_kinds(gallery, size, lights, black_point)
        height, width = size
        if min(height, width) < 1:
            raise InputError(f"crops of {height}x{width} px were asked for, expected 1 or more")
        small = np.flatnonzero((gallery.sizes < (height, width)).any(axis=1))
        if small.size:
            tall, wide = gallery.sizes[small[0]]
            raise InputError(
                f"{small.size} of {len(gallery)} pictures are smaller than a crop of {height}x{width} px (height x "
                f"width), the first is {gallery.names[small[0]]} of {tall}x{wide}; leave them out or cut smaller"
            )
        if not 1 <= length <= 1 << 32:
            raise InputError(f"an epoch of {length} items was asked for, expected 1 to 2^32")
        if not (0 < exposure[0] <= exposure[1] < np.inf):
            raise InputError(f"the exposure is {exposure}, expected least and largest gain above 0")
        if iso is not None and noise is None:
            raise InputError("an ISO speed was given without the noise of the table; give noise=measured_noise(lut)")
        philox.key_of(seed)
        chosen = range(len(lut.samples)) if lights is None else lights
        if not len(chosen):
            raise InputError("there is no light to draw from; name some or leave the choice out")
        mixtures = [light_of(light, lut) for light in chosen]
        whites = np.stack([mixture.white(lut) for mixture in mixtures])
        self.lut = lut
        self.gallery = gallery
        self.size = size
        self.length = length
        self.lights = tuple(mixtures)
        self.exposure = exposure
        self.noise = noise
        self.iso = iso
        self.flip = flip
        self.seed = seed
        self.epoch = self._checked_epoch(epoch)
        self.threads = threads
        self.rendering = rendering
        self.matrix = matrix
        self.black_point = black_point
        self._memory = Recycled()
        self._truths = (whites / whites.sum(axis=1, keepdims=True)).astype(np.float32)
        self._tables, self._rows = _tables_of(lut, self.lights if rendering == "codes" else (), seed)
        self._prints = _prints_of(lut, self.lights, rendering, matrix)
        self._pictures = [
            gallery.picture(number)
            if self._prints
            else replace_unfit_colours(gallery.picture(number), lut.provenance)[0]
            for number in range(len(gallery))
        ]
        self._blacks: list[npt.NDArray[np.float64]] = []
        if black_point.kind != "keep" and not self._prints:
            self._blacks = [veil_of(lut, mixture, 1.0).taken for mixture in mixtures]
        self._whites = np.minimum(whites, lut.provenance.white_level)

    def __reduce__(self) -> tuple[Any, ...]:
        # The table is gigabytes; its folder is enough to map it again.
        options = {name: getattr(self, name) for name in _OPTIONS}
        return _reopened, (self.lut.folder, self.gallery, self.size, options)

    @staticmethod
    def _checked_epoch(epoch: int) -> int:
        if not 0 <= epoch < 1 << 32:
            raise InputError(f"the epoch is {epoch}, expected 0 to 2^32 - 1")
        return epoch

    def set_epoch(self, epoch: int) -> None:
        """Make these the items of another epoch, as PyTorch's distributed samplers are.

        Raises
        ------
        InputError
            The epoch is not 0 … 2³² − 1.
        """
        self.epoch = self._checked_epoch(epoch)

    def __len__(self) -> int:
        """Return the items of an epoch."""
        return self.length

    def batch(self, items: npt.ArrayLike, out: npt.NDArray[np.float32] | None = None) -> Batch:
        """Return items by their numbers.

        Parameters
        ----------
        items
            (N,) int, 0 … length − 1, in any order, N ≥ 1.
        out
            (N, 3, height, width) float32 to fill: the batch's images. None: memory of a former batch of which nothing
            is left, or new memory.

        Raises
        ------
        InputError
            There is no such item, or `out` is of another shape or type.
        FormatError
            Samples of the table are not those that were measured; each light is looked at when it is first used.
        """
        numbers = np.asarray(items, dtype=np.int64)
        if numbers.ndim != 1 or not numbers.size or numbers.min() < 0 or numbers.max() >= self.length:
            raise InputError(f"items {items} were asked for, expected a list of numbers from 0 to {self.length - 1}")
        words = philox.words(self.seed, numbers, self.epoch, np.arange(3)[:, None], philox.ITEMS)
        (which, mirror, low), (across, stops, high), (down, veil, _), (light, _, _) = words
        pictures = _below(which, len(self.gallery))
        height, width = self.size
        free = self.gallery.sizes[pictures] - self.size + 1
        windows = np.empty((numbers.size, 4), np.int64)
        windows[:, 0], windows[:, 1] = _below(across, free[:, 1]), _below(down, free[:, 0])
        windows[:, 2:] = width, height
        lights = _below(light, len(self.lights))
        for used in set(map(int, lights)):
            for number in self.lights[used].lights:
                self.lut.require_unchanged(number)
        least, most = np.log2(self.exposure)
        gains = np.exp2(least + (most - least) * (stops / 2.0**32))
        seeds = low.astype(np.uint64) | high.astype(np.uint64) << _HALF
        shares = self.black_point.shares(veil)
        taken, stretches = None, np.float64(1)
        if self.black_point.kind != "keep":
            taken = shares[:, None] * np.stack([self._black_of(light) for light in map(int, lights)])
            stretches = 1 / (1 - taken / self._whites[lights])
        flips = (mirror >> 31).astype(bool) & self.flip
        shown = [self._pictures[place] for place in map(int, pictures)]
        out = self._memory.array((numbers.size, 3, height, width)) if out is None else out
        if self._prints:
            images = draw_printed_crops(
                self.lut.samples,
                [self._prints[light] for light in map(int, lights)],
                shown,
                windows,
                self._prints.cells,
                scales=scales_of(gains, self.lut.provenance.white_level, taken, stretches),
                flips=flips,
                seeds=seeds,
                threads=self.threads,
                out=out,
            )
        else:
            images = draw_batch(
                self._tables,
                self._rows[lights],
                shown,
                windows,
                white_level=self.lut.provenance.white_level,
                flips=flips,
                gains=gains,
                seeds=seeds,
                taken=taken,
                stretches=stretches,
                threads=self.threads,
                out=out,
            )
        if self.noise is not None:
            ratio = 1.0 if self.iso is None else self.iso.ratio
            wanted = self.noise if self.iso is None else self.noise.at(ratio, self.iso.sensor_electrons)
            white = self.lut.provenance.white_level
            add_noise(
                images,
                gains,
                self.noise,
                seeds,
                white_level=white,
                wanted=wanted,
                ratio=ratio,
                below_black=taken is not None,
                threads=self.threads,
            )
        return Batch(images, self._truths[lights], lights, pictures, shares)

    def _black_of(self, light: int) -> npt.NDArray[np.float64]:
        """Return what a black point takes of a light at most, (3,) counts."""
        return self._prints.black(light) if self._prints else self._blacks[light]

    def __getitem__(self, item: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return the image (3, height, width) float32 and the illuminant (3,) float32 of one item.

        Raises
        ------
        IndexError
            There is no such item; a loop over the items ends there.
        """
        if not 0 <= item < self.length:
            raise IndexError(f"item {item} of {self.length}")
        batch = self.batch([item])
        return batch.images[0], batch.illuminants[0]


def _require_kinds(gallery: object, size: object, lights: object, black_point: object) -> None:
    """Refuse arguments of another kind than expected, each with what makes one of that kind."""
    if not isinstance(gallery, Gallery):
        raise InputError(
            f"the gallery is {value_text(gallery)}, expected one of gallery_of([picture, …]) or open_gallery(FOLDER)"
        )
    if np.shape(size) != (2,) or isinstance(size, str):  # pyrefly: ignore[no-matching-overload]
        raise InputError(f"the size of crops is {value_text(size)}, expected height and width, such as (128, 128)")
    if isinstance(lights, int | str | Mixture):
        raise InputError(f"the lights are {value_text(lights)}, expected a list, such as [0, 3] or ['D65']")
    if not isinstance(black_point, BlackPoint):
        raise InputError(
            f"the black point is {value_text(black_point)}, expected 'keep', 'compensate', 'random' or 'random:MAX'"
        )


def _below(words: npt.NDArray[np.uint32], bound: int | npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return whole numbers (N,) int64, 0 … bound − 1, from random words (N,) uint32."""
    return (words.astype(np.uint64) * np.asarray(bound, dtype=np.uint64) >> _HALF).astype(np.int64)


# Keywords of `Crops`, each kept in an attribute of its name.
_OPTIONS: Final = (
    "length",
    "lights",
    "exposure",
    "noise",
    "iso",
    "flip",
    "seed",
    "epoch",
    "threads",
    "rendering",
    "matrix",
    "black_point",
)


def _reopened(folder: Path, gallery: Gallery, size: tuple[int, int], options: dict[str, Any]) -> Crops:
    return Crops(open_lut(folder), gallery, size, **options)


def _tables_of(lut: Lut, lights: Sequence[Mixture], seed: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.int64]]:
    """Return tables of samples (T, 8**bits, S, 3) uint16, and for each light its row in them (N,) int64."""
    if all(len(mixture.lights) == 1 for mixture in lights):
        return lut.samples, np.array([mixture.lights[0] for mixture in lights], dtype=np.int64)
    return np.stack([mixture.samples(lut, seed) for mixture in lights]), np.arange(len(lights))


class _Prints:
    """For each light what it makes of the print, found when it is first asked for."""

    def __init__(self, lut: Lut, lights: Sequence[Mixture], matrix: ColourMatrix | None) -> None:
        self._lut = lut
        self._lights = lights
        self._rendering = ColorimetricRendering(lut, matrix or matrix_for(lut))
        self._found: dict[int, PrintedLight] = {}
        self._blacks: dict[int, npt.NDArray[np.float64]] = {}

    @property
    def cells(self) -> npt.NDArray[np.uint32]:
        """The cell whose samples each node has; see `kernels.printing`."""
        return self._rendering.cells

    def __getitem__(self, light: int) -> PrintedLight:
        """Return what a light makes of the print."""
        if light not in self._found:
            self._found[light] = self._rendering.printed(self._lights[light])
        return self._found[light]

    def black(self, light: int) -> npt.NDArray[np.float64]:
        """Return what black was mapped to under a light, (3,) counts; a QualityError where it is half as bright."""
        if light not in self._blacks:
            mixture = self._lights[light]
            self._blacks[light] = veil_of(self._lut, mixture, 1.0, self._rendering.black(mixture)).taken
        return self._blacks[light]


def _prints_of(
    lut: Lut, lights: Sequence[Mixture], rendering: Rendering, matrix: ColourMatrix | None
) -> _Prints | None:
    """Return what lights make of the print; None where codes are those of the print."""
    if rendering not in get_args(Rendering):
        raise InputError(f"{rendering!r} is no rendering; use one of {', '.join(get_args(Rendering))}")
    if rendering == "colorimetric":
        return _Prints(lut, lights, matrix)
    if matrix is not None:
        raise InputError("a colour matrix is for colorimetric rendering; choose that, or leave the matrix out")
    return None
