"""Influence of colour reduction: linear images after bits of their sRGB codes were set to zero (section 4.2).

Real linear images are tone mapped by Flash to codes of 8 bits, the lowest n bits of each code are set to zero, and the
reversed operator takes them back to linear; then methods estimate their lights. Flash's k and scale are those of the
image before (`generator.files`), so that with n = 0 only the rounding to whole codes is left. Masked pixels
have no say in k and scale.

In files, linear images become codes of 8 bits and codes linear images; a folder of codes lies so::

    codes/NAME.png   8-bit RGB, the image tone mapped, of whose codes the lowest bits may be zero
    masks/NAME.png   not 0 where a pixel is masked or clipped, where there is such a pixel
    flash.csv        image,codes,mask,k,scale,gamma,largest,r,g,b: the operator of each image, which undoes it

Codes may be changed by any program before they are taken back, or be replaced by a JPEG of the same name: what that
does to methods is then seen. The linear images are TIFF files of 32-bit floats in the units of the data set, with a
table of their lights, as `evaluation.datasets.plain_folder` reads them.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.running import require_truths
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Method
from evaluation.methods.prepared import usable
from evaluation.methods.standard import standard_methods
from evaluation.metrics import ErrorKind
from evaluation.results.result import Result, SceneAnswer, read_light, results_of
from evaluation.results.tables import PAPER_COLUMNS, Table
from evaluation.scene import Image, Scene, SceneSet, told_of
from foundation.compiled import ordered_map
from foundation.errors import FormatError, InputError
from foundation.files import is_inside_name, read_inside, reading_error, write_whole
from foundation.folders import whole_folder
from generator.files import Flash, fit_flash
from generator.pictures.sources import clear_bits

BITS: Final = tuple(range(8))
"""Numbers of bits set to zero, as in the paper's figure."""

GRAY_EDGE_SIGMA: Final = 6.0
"""Scale of Gray-Edge, px: that of its entry in the NUS tables, for images of full size."""


def reduce_colours(
    image: Image, bits: int | Sequence[int], mask: npt.NDArray[np.bool_] | None = None
) -> list[npt.NDArray[np.float32]]:
    """Return a linear image after `bits` bits of its tone-mapped codes were set to zero, for each of these numbers.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, any unit. `mask`: (H, W) bool, True where a
    pixel has no say in the operator. Returns for each number (H, W, 3) float32, in units of the image's largest
    unmasked value.

    Examples
    --------
    >>> wall = np.array([[[500.0, 1000.0, 700.0], [20.0, 30.0, 10.0]]])
    >>> raw, coarse = reduce_colours(wall, (0, 6))
    >>> raw.round(3)
    array([[[0.5  , 1.   , 0.701],
            [0.02 , 0.03 , 0.01 ]]], dtype=float32)
    >>> coarse.round(3)
    array([[[0.143, 0.349, 0.349],
            [0.   , 0.023, 0.   ]]], dtype=float32)
    """
    counts = (bits,) if isinstance(bits, int) else tuple(bits)
    found = fitted_codes(image, mask)
    return [found.operator.invert(clear_bits(found.codes, count)).astype(np.float32) for count in counts]


@dataclass(frozen=True, eq=False)
class FittedCodes:
    """A linear image after Flash.

    - `codes`: (H, W, 3) uint8.
    - `operator`: that made them, of values relative to `largest`.
    - `largest`: largest value that is not masked, in the image's unit; 0 of a black image.
    """

    codes: npt.NDArray[np.uint8]
    operator: Flash
    largest: float


def fitted_codes(image: Image, mask: npt.NDArray[np.bool_] | None = None) -> FittedCodes:
    """Return the codes of 8 bits of a linear image, by the operator that is fitted to it.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, any unit. `mask`: (H, W) bool, True where a
    pixel has no say in the operator.
    """
    values = np.asarray(image, dtype=np.float64)
    seen = values.reshape(-1, 3) if mask is None else values[~mask]
    largest = float(seen.max(initial=0.0))
    if not largest:
        return FittedCodes(np.zeros(values.shape, np.uint8), Flash(1.0, 255.0, 1.0), 0.0)
    operator = fit_flash(seen / largest)
    codes = np.clip(np.rint(operator.apply(values / largest)), 0, 255).astype(np.uint8)
    return FittedCodes(codes, operator, largest)


def bits_methods(sigma: float = GRAY_EDGE_SIGMA) -> tuple[Method, ...]:
    """Return the methods of the paper's figure: Gray-world, Shades-of-Gray, Gray-Edge of order 1 at a scale in px."""
    known = standard_methods()
    edge = (
        known["gray-edge-1"]
        if sigma == GRAY_EDGE_SIGMA
        else GrayEdge(f"1st-order Gray-Edge (σ={sigma:g})", 1, 1, sigma)
    )
    return (known["gray-world"], known["shades-of-gray"], edge)


@dataclass(frozen=True, eq=False)
class BitsResult:
    """What methods made of a data set's images, as they are and after bits were set to zero.

    - `raw`: one result a method, on the images as they are.
    - `reduced`: the same by the number of bits set to zero.
    """

    raw: tuple[Result, ...]
    reduced: Mapping[int, tuple[Result, ...]]


def bits_removed(
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    bits: Sequence[int] = BITS,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> BitsResult:
    """Return errors of methods on images with bits set to zero; each image is read once.

    `scenes`: real linear images with their ground truths, at least one.
    """
    truths = require_truths(scenes, methods)

    def answers_for(scene: Scene) -> list[list[SceneAnswer]]:
        image, mask = scene.read()
        # Clipped pixels are known before the reduction only; they have their say in the operator, as in a camera.
        left_out = ~usable(image, scene.saturation, mask)
        versions: list[Image] = [image, *reduce_colours(image, bits, mask)]
        return [[read_light(method.estimate(version, None, left_out)) for method in methods] for version in versions]

    answers = list(told_of(ordered_map(answers_for, scenes, workers), on_scene))
    names = [method.name for method in methods]
    raw, *reduced = (
        results_of(names, truths, [given[version] for given in answers]) for version in range(1 + len(bits))
    )
    return BitsResult(raw, dict(zip(bits, reduced, strict=True)))


def bits_table(found: BitsResult, kind: ErrorKind, name: str) -> Table:
    """Return the six numbers of every method for the images as they are and each number of bits."""
    versions = {"as it is": found.raw, **{str(count): results for count, results in found.reduced.items()}}
    return Table(
        f"{name}: {kind} angular error after bits of the codes that Flash makes were set to zero, degrees",
        ("Algorithm", "Bits set to zero", *PAPER_COLUMNS[1:]),
        tuple(
            (results[place].method, label, *results[place].summary(kind).as_tuple())
            for place in range(len(found.raw))
            for label, results in versions.items()
        ),
        notes=("0 bits: rounded to codes of 8 bits and taken back, nothing set to zero.",),
    )


TABLE: Final = "flash.csv"
COLUMNS: Final = ("image", "codes", "mask", "k", "scale", "gamma", "largest", "r", "g", "b")

_MOST_BYTES: Final = 1 << 30
"""Largest file of codes that is read: a picture of a gigabyte is none of a camera."""
_ENDINGS: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Of files that may stand in place of the codes that were written, the first that is there."""


@dataclass(frozen=True)
class CodedImage:
    """A row of the table.

    - `image`: the image's name in its data set.
    - `codes`, `mask`: names of the files below the folder; an empty mask where every pixel may be used.
    - `operator`: that made its codes, of values relative to `largest`.
    - `largest`: largest value that is not masked, in the units of the data set.
    - `light`: ground truth, linear camera RGB of sum 1.
    """

    image: str
    codes: str
    mask: str
    operator: Flash
    largest: float
    light: tuple[float, float, float]


def write_codes(
    data: SceneSet, out: Path, cleared: int = 0, workers: int = 1, on_scene: Callable[[], None] | None = None
) -> None:
    """Write the codes of a data set's linear images into a new folder."""
    names = [_file_name(scene.name) for scene in data.scenes]
    if len(set(names)) != len(names):
        raise InputError(f"images of {data.name} have names that differ in their endings only; name a part of it")
    clear_bits(np.zeros(1, np.uint8), cleared)
    with whole_folder(out, "the codes") as folder:
        rows: list[str] = [",".join(COLUMNS)]

        def write(numbered: tuple[Scene, str]) -> str:
            scene, name = numbered
            image, mask = scene.read()
            found = fitted_codes(image, mask)
            left_out = ~usable(image, scene.saturation, mask)
            _write_png(folder / "codes" / name, clear_bits(found.codes, cleared)[..., ::-1])
            if left_out.any():
                _write_png(folder / "masks" / name, left_out.astype(np.uint8) * np.uint8(255))
            operator, light = found.operator, scene.truth / scene.truth.sum()
            numbers = (operator.k, operator.scale, operator.gamma, found.largest, *light.tolist())
            files = (scene.name, f"codes/{name}", f"masks/{name}" if left_out.any() else "")
            return _row(*files, *(f"{number:.17g}" for number in numbers))

        rows += told_of(ordered_map(write, list(zip(data.scenes, names, strict=True)), workers), on_scene)
        write_whole(folder / TABLE, "\n".join(rows) + "\n")


def write_linear(folder: Path, out: Path, workers: int = 1, on_image: Callable[[int, int], None] | None = None) -> int:
    """Write the linear images that a folder of codes stands for into a new folder, and return how many."""
    import tifffile

    coded = list(read_table(folder))
    with whole_folder(out, "the linear images") as made:
        rows = ["image,r,g,b,mask"]

        def write(row: CodedImage) -> str:
            codes = _read_codes(folder, row.codes)
            linear = row.operator.invert(codes) * row.largest
            name = str(Path(row.codes).with_suffix(".tiff").relative_to("codes"))
            image = io.BytesIO()
            tifffile.imwrite(image, linear.astype(np.float32), photometric="rgb", metadata=None)
            _write(made / name, image.getvalue())
            mask = f"{name.removesuffix('.tiff')}_mask.png" if row.mask else ""
            if mask:
                _write(made / mask, _read(folder, row.mask))
            return _row(name, *(f"{part:.17g}" for part in row.light), mask)

        for done, row in enumerate(ordered_map(write, coded, workers), 1):
            rows.append(row)
            if on_image:
                on_image(done, len(coded))
        write_whole(made / "gt.csv", "\n".join(rows) + "\n")
    return len(coded)


def read_table(folder: Path) -> Iterator[CodedImage]:
    """Yield the rows of a folder of codes."""
    place = folder / TABLE
    try:
        text = _read(folder, TABLE).decode("utf-8-sig")
        rows = csv.DictReader(io.StringIO(text))
        if set(COLUMNS) - set(rows.fieldnames or ()):
            raise ValueError(f"it lacks columns of {','.join(COLUMNS)}")
        for row in rows:
            try:
                yield _coded(row)
            except (TypeError, ValueError) as error:
                raise ValueError(f"line {rows.line_num}: {error}") from error
    except (ValueError, csv.Error) as error:
        raise FormatError(f"{place} is damaged: {error}; write the codes again with evaluate paper flash") from error


def _coded(row: Mapping[str, str]) -> CodedImage:
    for file in filter(None, (row["codes"], row["mask"])):
        if not is_inside_name(file) or not file.startswith(("codes/", "masks/")):
            raise ValueError(f"{file!r} is no name below codes/ or masks/")
    k, scale, gamma, largest, red, green, blue = (float(row[name]) for name in COLUMNS[3:])
    if not all(0 < number < np.inf for number in (k, scale, gamma)) or not 0 <= largest < np.inf:
        raise ValueError("k, scale and gamma are to be above 0, largest from 0")
    return CodedImage(row["image"], row["codes"], row["mask"], Flash(k, scale, gamma), largest, (red, green, blue))


def _read_codes(folder: Path, name: str) -> npt.NDArray[np.uint8]:
    """Return codes (H, W, 3) uint8, red first."""
    import cv2

    there = [file for ending in _ENDINGS if (folder / (file := str(Path(name).with_suffix(ending)))).is_file()]
    if not there:
        raise FormatError(f"{folder / name} is missing; restore it, or write the codes again")
    data = np.frombuffer(_read(folder, there[0]), np.uint8)
    codes = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if codes is None or codes.dtype != np.uint8 or codes.ndim != 3 or codes.shape[2] != 3:
        held = "nothing that can be read" if codes is None else f"{codes.dtype} {codes.shape}"
        raise FormatError(f"{folder / there[0]} holds {held}, expected a picture of 8 bits, RGB; write the codes again")
    return np.asarray(codes[..., ::-1], np.uint8)


def _read(folder: Path, name: str) -> bytes:
    try:
        return read_inside(folder, name, _MOST_BYTES)
    except OSError as error:
        raise reading_error(folder / name, error, "write the codes again with evaluate paper flash") from error


def _file_name(image: str) -> str:
    """Return the name of the PNG file of an image's codes."""
    name = image if image.lower().endswith(".png") else f"{image}.png"
    if not is_inside_name(name):
        raise InputError(f"the image {image!r} makes no name of a file; rename it")
    return name


def _row(*fields: str) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(fields)
    return text.getvalue()


def _write_png(path: Path, picture: npt.NDArray[np.uint8]) -> None:
    import cv2

    _write(path, cv2.imencode(".png", picture)[1].tobytes())


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, data)


PANEL: Final = 200
"""Longest side of a panel, px: eight of them fit a page, and the steps of 3 bits can still be seen."""

_GAP: Final = 6
"""White between panels, px."""

_COLUMNS: Final = 4
"""Panels side by side."""


def reduction_strip(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> npt.NDArray[np.uint8]:
    """Return the panels of a picture with bits set to zero, four in a row, white between them.

    `picture`: (H, W, 3) uint8, sRGB codes; made smaller first if a side is above `PANEL`. Returns (h, w, 3) uint8, sRGB
    codes.
    """
    import cv2

    scale = min(1.0, PANEL / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    width, height = size
    rows = -(-len(bits) // _COLUMNS)
    columns = min(_COLUMNS, len(bits))
    shape = (rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3)
    strip = np.full(shape, 255, np.uint8)
    for place, count in enumerate(bits):
        top, left = place // _COLUMNS * (height + _GAP), place % _COLUMNS * (width + _GAP)
        strip[top : top + height, left : left + width] = clear_bits(small, count)
    return strip


def reduction_table(picture: npt.NDArray[np.uint8], bits: Sequence[int] = BITS) -> Table:
    """Return what is left of a picture (H, W, 3) uint8, sRGB codes: its colours and its distance from the original."""
    rows: list[tuple[str | float | None, ...]] = []
    for count in bits:
        reduced = clear_bits(picture, count)
        colours = len(np.unique(reduced.reshape(-1, 3), axis=0))
        error = float(np.mean((reduced.astype(np.float64) - picture) ** 2))
        ratio = 10 * float(np.log10(255**2 / error)) if error else None
        rows.append((count, 8 ** (8 - count), colours, ratio))
    return Table(
        "A picture with its colours reduced",
        ("Bits set to zero", "Colours possible", "Colours in the picture", "Peak signal to noise, dB"),
        tuple(rows),
        digits=1,
    )
