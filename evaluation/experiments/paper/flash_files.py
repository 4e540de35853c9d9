"""Flash and its inverse in files: linear images as codes of 8 bits, and codes as linear images (section 4.2).

A folder of codes lies so::

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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.paper.bits import fitted_codes
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Scene, SceneSet
from foundation.errors import FormatError, InputError
from foundation.files import reading_error, whole_folder, write_whole
from foundation.foreign_folders import is_inside_name, read_inside
from foundation.processors import ordered_map
from generator.pictures.picture import clear_bits
from generator.pictures.preview import Flash

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
        rows = [",".join(COLUMNS)]

        def write(numbered: tuple[Scene, str]) -> str:
            scene, name = numbered
            image, mask = scene.read()
            found = fitted_codes(image, mask)
            left_out = ~PreparedImage(image, scene.saturation, mask).usable()
            _write_png(folder / "codes" / name, clear_bits(found.codes, cleared)[..., ::-1])
            if left_out.any():
                _write_png(folder / "masks" / name, left_out.astype(np.uint8) * np.uint8(255))
            operator, light = found.operator, scene.truth / scene.truth.sum()
            numbers = (operator.k, operator.scale, operator.gamma, found.largest, *light.tolist())
            files = (scene.name, f"codes/{name}", f"masks/{name}" if left_out.any() else "")
            return _row(*files, *(f"{number:.17g}" for number in numbers))

        for row in ordered_map(write, list(zip(data.scenes, names, strict=True)), workers):
            rows.append(row)
            if on_scene:
                on_scene()
        write_whole(folder / TABLE, "\n".join(rows) + "\n")


def write_linear(folder: Path, out: Path, workers: int = 1, on_image: Callable[[int, int], None] | None = None) -> int:
    """Write the linear images that a folder of codes stands for into a new folder, and return how many."""
    coded = list(read_table(folder))
    with whole_folder(out, "the linear images") as made:
        rows = ["image,r,g,b,mask"]

        def write(row: CodedImage) -> str:
            codes = _read_codes(folder, row.codes)
            linear = row.operator.invert(codes) * row.largest
            name = str(Path(row.codes).with_suffix(".tiff").relative_to("codes"))
            _write(made / name, _tiff(linear.astype(np.float32)))
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


def _tiff(image: npt.NDArray[np.float32]) -> bytes:
    import tifffile

    stream = io.BytesIO()
    tifffile.imwrite(stream, image, photometric="rgb", metadata=None)
    return stream.getvalue()


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, data)
