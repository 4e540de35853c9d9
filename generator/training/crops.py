"""Training batches: crops of pictures under newly drawn illuminants, with their ground truths.

`Crops` draws any number of crops from a look-up table (LUT) and a gallery. Item i of an epoch depends only on seed,
epoch and i. Its random numbers are the words of Philox4x32-10 with counter (i, epoch, k, 7). k = 0: picture, column,
row, illuminant; k = 1: mirroring, gain, subtracted share of the print's black; k = 2: seed of the samples. Items do not
depend on the number of workers.

Only `torch_crops` needs PyTorch; it has data sets for PyTorch::

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
from foundation.errors import InputError, counted, value_text
from generator import philox
from generator.kernels.planar import draw_batch, scales_of
from generator.kernels.printed_crops import draw_printed_crops
from generator.kernels.printing import PrintedLight
from generator.kernels.unfit import replace_unfit_colours
from generator.lights.choices import light_of
from generator.lights.lighting import Mixture
from generator.rendering import DEFAULT, Rendering
from generator.rendering.black_points import KEEP, BlackPoint, black_subtraction, parse_black_point
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


KEPT_BLOCKS: Final = 2  # Memory blocks kept for reuse: a loop still refers to one batch while it gets the next


class RecycledMemory:
    """Large arrays in reused memory, because the system clears each new page of a program.

    Clearing takes half as long as drawing a batch. Memory is reused when the array and all views of it are gone.
    Threads may share an instance.
    """

    def __init__(self) -> None:
        self._free: deque[mmap.mmap] = deque(maxlen=KEPT_BLOCKS)

    def array(self, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
        """Return an array (...) float32 in C order, with arbitrary content."""
        size = 4 * int(np.prod(shape))
        memory = self._memory(size)
        # In numpy, the base of a view of a view is the first array, here `values`. `values` therefore exists as long as
        # any view of it, and is finalised when the last view is gone.
        values = np.frombuffer(memory, dtype=np.float32)
        weakref.finalize(values, self._free.append, memory).atexit = False
        return values.reshape(shape)

    def _memory(self, size: int) -> mmap.mmap:
        with contextlib.suppress(IndexError):
            while len(memory := self._free.pop()) != size:
                pass
            return memory
        memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        # Huge pages, if available, reduce the page faults to 1/500.
        if hasattr(mmap, "MADV_HUGEPAGE"):
            memory.madvise(mmap.MADV_HUGEPAGE)
        return memory


_WORD_BITS: Final = np.uint64(32)  # Bits of a random word


@dataclass(frozen=True, eq=False)
class Batch:
    """N training crops.

    Attributes
    ----------
    images
        (N, 3, height, width) float32, linear camera RGB, 0 … 1 = saturation. If the print's black is subtracted, noise
        reaches below 0 by a few thousandths, because clipping would make black too bright. Clip before taking
        logarithms or roots.
    illuminants
        (N, 3) float32, ground truths, r + g + b = 1.
    lights
        (N,) int64, index of the illuminant of each crop in `Crops.lights`.
    pictures
        (N,) int64, index of the picture of each crop in the gallery.
    black_taken
        (N,) float64, share of the print's black that was subtracted, 0 … 1.

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

    def __repr__(self) -> str:
        """Return one line."""
        count, _, height, width = self.images.shape
        return f"Batch({counted(count, 'crop')} of {height}x{width} px)"


class Crops:
    """Crops of the pictures of a gallery under the illuminants of a LUT.

    Parameters
    ----------
    lut
        The LUT.
    gallery
        The pictures, each at least as large as a crop. With ``"codes"``, colours that the LUT lists as unfit are
        replaced by the nearest fit colours in a copy in memory.
    size
        Height and width of a crop, px.
    length
        Number of crops per epoch, 1 … 2³².
    lights
        Illuminants, drawn with equal probability: indices in the LUT, texts as for the option ``--light``, such as
        ``"D65"`` or ``"5600K"``, or mixtures. With ``"codes"``, mixtures take 5 MB of memory per illuminant. None: all
        illuminants of the LUT.
    exposure
        Smallest and largest gain, > 0. Gains are drawn uniformly in stops. Values above saturation are clipped.
    noise
        Noise of the samples, `generator.variation.sensor_noise.measured_noise(lut)`. Crops with a gain below 1 then get
        the noise of a camera in less light. With None, the gain scales signal and noise equally.
    iso
        ISO speed that determines the noise of the crops; needs `noise`. None for the speed of the LUT. Crops
        with a gain above `iso.ratio` have the noise of a higher ISO speed.
    flip
        Mirror half of the crops left to right.
    seed
        0 … 2⁶⁴ − 1.
    epoch
        0 … 2³² − 1; see `set_epoch`.
    threads
        Number of threads that share a batch. The result does not depend on it.
    rendering
        ``"colorimetric"``: the camera records the colours of the picture. The first use of a LUT takes seconds; the
        result is stored in the cache folder of the user. Each illuminant takes 0.5 MB of memory. ``"codes"``: the print
        has the codes of the picture, as in the paper.
    matrix
        Linear sRGB to camera RGB, for colorimetric rendering; None for the matrix of the LUT's camera.
    black_point
        Treatment of the print's black; also as a text for the option ``--black-point``, such as ``"random"``.

    Raises
    ------
    InputError
        If a value is out of range, an illuminant is not in the LUT, or a picture is smaller than a crop.

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
        _require_types(gallery, size, lights, black_point)
        height, width = size
        if min(height, width) < 1:
            raise InputError(f"the crops have {height}x{width} px, expected 1x1 or more")
        small = np.flatnonzero((gallery.sizes < (height, width)).any(axis=1))
        if small.size:
            tall, wide = gallery.sizes[small[0]]
            raise InputError(
                f"{small.size} of {len(gallery)} pictures are smaller than a crop of {height}x{width} px (height x "
                f"width), the first is {gallery.names[small[0]]} with {tall}x{wide}; remove them or use smaller crops"
            )
        if not 1 <= length <= 1 << 32:
            raise InputError(f"an epoch has {length} crops, expected 1 to 2^32")
        if not (0 < exposure[0] <= exposure[1] < np.inf):
            raise InputError(f"the exposure is {exposure}, expected smallest and largest gain, > 0 and rising")
        if iso is not None and noise is None:
            raise InputError("`iso` is given without the noise of the LUT; add noise=measured_noise(lut)")
        philox.key_of(seed)
        choices = range(len(lut.samples)) if lights is None else lights
        if not len(choices):
            raise InputError("`lights` is empty, expected 1 or more illuminants; omit it for all")
        mixtures = [light_of(light, lut) for light in choices]
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
        self._memory = RecycledMemory()
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
            self._blacks = [black_subtraction(lut, mixture, 1.0).counts for mixture in mixtures]
        self._whites = np.minimum(whites, lut.provenance.white_level)

    def __reduce__(self) -> tuple[Any, ...]:
        # The LUT has gigabytes, so workers do not receive it but open its folder again.
        options = {name: getattr(self, name) for name in _OPTIONS}
        return _reopened, (self.lut.folder, self.gallery, self.size, options)

    @staticmethod
    def _checked_epoch(epoch: int) -> int:
        if not 0 <= epoch < 1 << 32:
            raise InputError(f"the epoch is {epoch}, expected 0 to 2^32 - 1")
        return epoch

    def set_epoch(self, epoch: int) -> None:
        """Switch to the crops of another epoch, like the distributed samplers of PyTorch.

        Parameters
        ----------
        epoch
            0 … 2³² − 1.

        Raises
        ------
        InputError
            If the epoch is out of range.
        """
        self.epoch = self._checked_epoch(epoch)

    def __repr__(self) -> str:
        """Return one line; the list of illuminants may be very long."""
        height, width = self.size
        lights = counted(len(self.lights), "illuminant")
        return f"Crops({counted(self.length, 'crop')} of {height}x{width} px, {lights}, {self.gallery!r}, {self.lut!r})"

    def __len__(self) -> int:
        """Return the number of crops per epoch."""
        return self.length

    def batch(self, items: npt.ArrayLike, out: npt.NDArray[np.float32] | None = None) -> Batch:
        """Draw crops by their numbers.

        Parameters
        ----------
        items
            (N,) int, 0 … length − 1, in any order, N ≥ 1.
        out
            (N, 3, height, width) float32 to fill with the images. None: memory of an earlier batch that is not
            referenced any more, or new memory.

        Returns
        -------
        Batch
            The crops and their ground truths.

        Raises
        ------
        InputError
            If a number is out of range, or `out` has another shape or type.
        FormatError
            If samples of the LUT were changed; each illuminant is verified at its first use.
        """
        numbers = np.asarray(items, dtype=np.int64)
        if numbers.ndim != 1 or not numbers.size or numbers.min() < 0 or numbers.max() >= self.length:
            raise InputError(f"the items are {items}, expected a list of numbers from 0 to {self.length - 1}")
        words = philox.words(self.seed, numbers, self.epoch, np.arange(3)[:, None], philox.ITEMS)
        (picture_word, flip_word, low), (x_word, gain_word, high), (y_word, black_word, _), (light, _, _) = words
        pictures = _bounded(picture_word, len(self.gallery))
        height, width = self.size
        starts = self.gallery.sizes[pictures] - self.size + 1
        windows = np.empty((numbers.size, 4), np.int64)
        windows[:, 0], windows[:, 1] = _bounded(x_word, starts[:, 1]), _bounded(y_word, starts[:, 0])
        windows[:, 2:] = width, height
        lights = _bounded(light, len(self.lights))
        for drawn_light in set(map(int, lights)):
            for number in self.lights[drawn_light].lights:
                self.lut.require_unchanged(number)
        smallest_stops, largest_stops = np.log2(self.exposure)
        gains = np.exp2(smallest_stops + (largest_stops - smallest_stops) * (gain_word / 2.0**32))
        seeds = low.astype(np.uint64) | high.astype(np.uint64) << _WORD_BITS
        shares = self.black_point.shares(black_word)
        black_counts, stretches = None, np.float64(1)
        if self.black_point.kind != "keep":
            black_counts = shares[:, None] * np.stack([self._black_of(light) for light in map(int, lights)])
            stretches = 1 / (1 - black_counts / self._whites[lights])
        flips = (flip_word >> 31).astype(bool) & self.flip
        sources = [self._pictures[picture] for picture in map(int, pictures)]
        out = self._memory.array((numbers.size, 3, height, width)) if out is None else out
        if self._prints:
            images = draw_printed_crops(
                self.lut.samples,
                [self._prints[light] for light in map(int, lights)],
                sources,
                windows,
                self._prints.cells,
                scales=scales_of(gains, self.lut.provenance.white_level, black_counts, stretches),
                flips=flips,
                seeds=seeds,
                threads=self.threads,
                out=out,
            )
        else:
            images = draw_batch(
                self._tables,
                self._rows[lights],
                sources,
                windows,
                white_level=self.lut.provenance.white_level,
                flips=flips,
                gains=gains,
                seeds=seeds,
                black_counts=black_counts,
                stretches=stretches,
                threads=self.threads,
                out=out,
            )
        if self.noise is not None:
            iso_ratio = 1.0 if self.iso is None else self.iso.ratio
            target_noise = self.noise if self.iso is None else self.noise.at(iso_ratio, self.iso.sensor_electrons)
            white_level = self.lut.provenance.white_level
            add_noise(
                images,
                gains,
                self.noise,
                seeds,
                white_level=white_level,
                target_noise=target_noise,
                iso_ratio=iso_ratio,
                below_black=black_counts is not None,
                threads=self.threads,
            )
        return Batch(images, self._truths[lights], lights, pictures, shares)

    def _black_of(self, light: int) -> npt.NDArray[np.float64]:
        return self._prints.black(light) if self._prints else self._blacks[light]

    def __getitem__(self, item: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return the image (3, height, width) float32 and the illuminant (3,) float32 of one crop.

        Raises
        ------
        IndexError
            If there is no such crop; a loop over the crops ends there.
        """
        if not 0 <= item < self.length:
            raise IndexError(f"item {item} of {self.length}")
        batch = self.batch([item])
        return batch.images[0], batch.illuminants[0]


def _require_types(gallery: object, size: object, lights: object, black_point: object) -> None:
    if not isinstance(gallery, Gallery):
        raise InputError(
            f"the gallery is {value_text(gallery)}, expected gallery_of([picture, …]) or open_gallery(FOLDER)"
        )
    if np.shape(size) != (2,) or isinstance(size, str):  # pyrefly: ignore[no-matching-overload]
        raise InputError(f"the size of the crops is {value_text(size)}, expected height and width, such as (128, 128)")
    if isinstance(lights, int | str | Mixture):
        raise InputError(f"the illuminants are {value_text(lights)}, expected a list, such as [0, 3] or ['D65']")
    if not isinstance(black_point, BlackPoint):
        raise InputError(
            f"the black point is {value_text(black_point)}, expected 'keep', 'compensate', 'random' or 'random:MAX'"
        )


def _bounded(words: npt.NDArray[np.uint32], bound: int | npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return (words.astype(np.uint64) * np.asarray(bound, dtype=np.uint64) >> _WORD_BITS).astype(np.int64)


# Keywords of `Crops`, each stored in the attribute of the same name.
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
    if all(len(mixture.lights) == 1 for mixture in lights):
        return lut.samples, np.array([mixture.lights[0] for mixture in lights], dtype=np.int64)
    return np.stack([mixture.samples(lut, seed) for mixture in lights]), np.arange(len(lights))


class _Prints:
    """The print under each illuminant, computed at first use."""

    def __init__(self, lut: Lut, lights: Sequence[Mixture], matrix: ColourMatrix | None) -> None:
        self._lut = lut
        self._lights = lights
        self._rendering = ColorimetricRendering(lut, matrix or matrix_for(lut))
        self._printed_lights: dict[int, PrintedLight] = {}
        self._blacks: dict[int, npt.NDArray[np.float64]] = {}

    @property
    def cells(self) -> npt.NDArray[np.uint32]:
        """Patch whose samples each node (`kernels.printing`) uses."""
        return self._rendering.cells

    def __getitem__(self, light: int) -> PrintedLight:
        """Return the print under an illuminant."""
        if light not in self._printed_lights:
            self._printed_lights[light] = self._rendering.printed_light(self._lights[light])
        return self._printed_lights[light]

    def black(self, light: int) -> npt.NDArray[np.float64]:
        """Return the counts (3,) that black becomes in the print; raise QualityError if they reach half of white."""
        if light not in self._blacks:
            mixture = self._lights[light]
            self._blacks[light] = black_subtraction(self._lut, mixture, 1.0, self._rendering.black(mixture)).counts
        return self._blacks[light]


def _prints_of(
    lut: Lut, lights: Sequence[Mixture], rendering: Rendering, matrix: ColourMatrix | None
) -> _Prints | None:
    if rendering not in get_args(Rendering):
        raise InputError(f"the rendering is {rendering!r}, expected one of {', '.join(get_args(Rendering))}")
    if rendering == "colorimetric":
        return _Prints(lut, lights, matrix)
    if matrix is not None:
        raise InputError("`matrix` is given for rendering by codes; use colorimetric rendering, or omit it")
    return None
