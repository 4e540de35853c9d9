"""A dataset folder: its description, its reader and its writer.

    images/NNNNNN.png    16-bit linear camera RGB in the units of the table; numbered from 000000 without holes
    previews/NNNNNN.jpg  the same, tone mapped, at most 512 px: the look of the raw, no white balance
    ground_truth.csv     image,source,illumination,r,g,b with r + g + b = 1, one row an image
    gt.txt               r g b a line in image order
    dataset.json         the table's hash, seed, options, sources with their hashes: enough to make every byte again
    SHA256SUMS           hashes of images and previews; `sha256sum -c SHA256SUMS` verifies

Images are in the order of the sources, and of each source's lights. A source that cannot be read is passed over, told
and listed; nothing after it depends on it but the numbers of the images. No byte depends on the workers, the clock or
the machine's paths; the encoders and decoders are the libraries', whose versions are recorded.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import io
import os
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError

from drivers.errors import FormatError, InputError
from drivers.storage import require_free, whole_folder, write_whole
from generator.illuminant import LightChoice, ListedLights
from generator.scene import Picture, Source

if TYPE_CHECKING:
    from calibration.lut import Lut

FORMAT = "crop.dataset"
VERSION = 1
COLUMNS = ("image", "source", "illumination", "r", "g", "b")
PREVIEW_SIDE = 512
"""Longest side of a preview, px."""

ImageFormat = Literal["png", "tiff"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Table(_Record):
    """The table a dataset was made from; `sha256` as `calibration.lut.Lut.sha256`."""

    sha256: str
    camera: str
    bits: int
    samples: int
    white_level: int
    software: str


class Light(_Record):
    """A light of the table that was used; `codes` as projected, `white` the ground truth in linear camera RGB."""

    illumination: int
    kind: str
    cct_k: float | None
    codes: tuple[int, int, int]
    white: tuple[float, float, float]

    @property
    def label(self) -> str:
        """Return what a person calls it: its temperature if a black body, else its codes."""
        return f"{self.cct_k:.0f} K" if self.cct_k is not None else "{} {} {}".format(*self.codes)


class SourceRecord(_Record):
    """A source picture that was used.

    Attributes
    ----------
    position
        Place in the list of sources, from 0; the choice of its lights depends on it.
    name, sha256
        What it was called, and the hash of its file; no hash where it was made and not read.
    width, height
        Size of its images, px.
    replaced_pixels
        Pixels of colours that the table lists as unfit, which took the nearest fit colour.
    """

    position: int
    name: str
    sha256: str | None
    width: int
    height: int
    replaced_pixels: int


class Skipped(_Record):
    """A source picture that could not be read."""

    position: int
    name: str


class Description(_Record):
    """The content of `dataset.json`.

    `options` holds the image format, the largest side, and how lights were chosen.
    """

    format: Literal["crop.dataset"] = FORMAT
    version: Literal[1] = VERSION
    software: str
    libraries: dict[str, str]
    table: Table
    seed: int
    options: dict[str, Any]
    images: int
    lights: list[Light]
    sources: list[SourceRecord]
    skipped: list[Skipped]


@dataclass(frozen=True)
class Entry:
    """One image: its file name, its source's name, its light's number, and the ground truth (r, g, b) of sum 1."""

    image: str
    source: str
    illumination: int
    truth: tuple[float, float, float]


@dataclass(frozen=True)
class Dataset:
    """A dataset on disk; images are read where they are used."""

    folder: Path
    description: Description
    entries: tuple[Entry, ...]

    def read_image(self, entry: Entry) -> npt.NDArray[np.uint16]:
        """Return the image (H, W, 3) uint16, linear camera RGB, `description.table.white_level` = saturation.

        Raises
        ------
        FormatError
            The file is missing, damaged or no 16-bit RGB image.
        """
        import cv2

        path = self.folder / "images" / entry.image
        try:
            data = np.frombuffer(path.read_bytes(), np.uint8)
        except OSError as error:
            raise FormatError(f"cannot read {path}: {error.strerror}; make the dataset again") from error
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
        if image is None or image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3:
            raise FormatError(f"{path} is no 16-bit RGB image, or damaged; make the dataset again")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint16)

    def preview_path(self, entry: Entry) -> Path:
        """Return where the preview of an image is, if the dataset has previews."""
        return self.folder / "previews" / f"{Path(entry.image).stem}.jpg"


def open_dataset(folder: Path) -> Dataset:
    """Open a dataset folder; reads no image.

    Raises
    ------
    FormatError
        The folder is no dataset, of a version not known here, or its files disagree.
    """
    path = folder / "dataset.json"
    try:
        description = Description.model_validate_json(path.read_bytes())
        text = (folder / "ground_truth.csv").read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FormatError(
            f"{folder} is no dataset: cannot read {error.filename} ({error.strerror}); make one with generate"
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        raise FormatError(
            f"{path} is no dataset's description: {'.'.join(map(str, first['loc']))}: {first['msg']}; "
            f"this software reads {FORMAT} of version {VERSION}"
        ) from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{folder / 'ground_truth.csv'} is no text; make the dataset again") from error
    entries: list[Entry] = []
    for number, row in enumerate(csv.DictReader(io.StringIO(text)), start=2):
        try:
            truth = (float(row["r"]), float(row["g"]), float(row["b"]))
            entries.append(Entry(row["image"], row["source"], int(row["illumination"]), truth))
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{folder / 'ground_truth.csv'}, line {number}: expected {','.join(COLUMNS)}") from error
    if len(entries) != description.images or len({entry.image for entry in entries}) != len(entries):
        raise FormatError(
            f"{folder / 'ground_truth.csv'} has {len(entries)} rows, expected one for each of the "
            f"{description.images} images of dataset.json; make the dataset again"
        )
    return Dataset(folder, description, tuple(entries))


@dataclass(frozen=True)
class _Read:
    picture: Picture
    sha256: str | None
    replaced: int


@dataclass(frozen=True)
class _Written:
    entry: Entry
    sums: tuple[tuple[str, str], ...]


def generate_dataset(
    lut: Lut,
    folder: Path,
    sources: Sequence[Source],
    lights: LightChoice | Sequence[int],
    *,
    seed: int = 0,
    form: ImageFormat = "png",
    max_side: int | None = None,
    workers: int = 1,
    previews: bool = True,
    on_image: Callable[[], None] | None = None,
    on_skip: Callable[[Source, str], None] | None = None,
) -> Dataset:
    """Make a dataset: every source picture under its lights.

    Parameters
    ----------
    lut
        The table.
    folder
        Where the dataset is to be; must be free. It appears when it is complete.
    sources
        The pictures; see `scene.find_pictures` and `scene.random_scenes`.
    lights
        Which lights fall on which picture; see `illuminant`. A sequence of numbers is the same for every picture.
    seed
        0 … 2⁶⁴ − 1; chooses the samples of every pixel.
    form
        File format of the images.
    max_side
        What the sources were made with, px; recorded only.
    workers
        Threads that read, render, encode and write; at most about three pictures are in memory for each.
    previews
        Whether to write small tone-mapped pictures beside the images.
    on_image
        Called after each image, from the calling thread.
    on_skip
        Called with each source that cannot be read, and the reason.

    Raises
    ------
    InputError
        A light is not in the table, the folder is taken, or there is no source.
    FormatError
        None of the sources can be read.
    StorageError
        The disk is full, read-only or gone; nothing is left behind.
    """
    from generator.palette import fit_picture

    choice: LightChoice = lights if isinstance(lights, LightChoice) else ListedLights(tuple(lights))
    if not sources or not choice.lights_each:
        raise InputError(f"{len(sources)} pictures under {choice.lights_each} lights make no image; name some of both")
    if workers < 1:
        raise InputError(f"{workers} workers were asked for, expected 1 or more")

    def read(source: Source) -> _Read:
        picture, replaced = fit_picture(source.read(), lut.provenance)
        return _Read(picture, source.sha256(), replaced)

    records: list[SourceRecord] = []
    skipped: list[Skipped] = []
    written: list[_Written] = []
    with whole_folder(folder, "the dataset") as partial:
        (partial / "images").mkdir()
        if previews:
            (partial / "previews").mkdir()
        pool = ThreadPoolExecutor(workers)
        pending: deque[Future[_Written]] = deque()
        ahead: deque[Future[_Read]] = deque()
        try:

            def finish_one() -> None:
                written.append(pending.popleft().result())
                if on_image:
                    on_image()

            number = 0
            for position, source in enumerate(sources):
                while len(ahead) <= workers and position + len(ahead) < len(sources):
                    ahead.append(pool.submit(read, sources[position + len(ahead)]))
                try:
                    got = ahead.popleft().result()
                except (FormatError, OSError) as error:
                    skipped.append(Skipped(position=position, name=source.name))
                    if on_skip:
                        on_skip(source, str(error))
                    continue
                height, width = got.picture.shape[:2]
                records.append(
                    SourceRecord(
                        position=position,
                        name=source.name,
                        sha256=got.sha256,
                        width=width,
                        height=height,
                        replaced_pixels=got.replaced,
                    )
                )
                for light in choice.lights_of(position):
                    while len(pending) >= 2 * workers:
                        finish_one()
                    name = f"{number:06d}"
                    job = (lut, partial, name, source.name, got.picture, light, seed, number, form, previews)
                    pending.append(pool.submit(_write_image, *job))
                    number += 1
            while pending:
                finish_one()
        finally:
            pool.shutdown(cancel_futures=True)
        if not written:
            raise FormatError(f"none of the {len(sources)} pictures can be read; name a folder of other pictures")
        used = sorted({image.entry.illumination for image in written})
        description = Description(
            software=software(),
            libraries=libraries(),
            table=_table_of(lut),
            seed=seed,
            options={"format": form, "max_side": max_side, "lights": choice.describe(), "previews": previews},
            images=len(written),
            lights=[_light_of(lut, light) for light in used],
            sources=records,
            skipped=skipped,
        )
        entries = tuple(image.entry for image in written)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        for entry in entries:
            writer.writerow([entry.image, entry.source, entry.illumination, *(f"{part:.9f}" for part in entry.truth)])
        truths = "".join("{:.9f} {:.9f} {:.9f}\n".format(*entry.truth) for entry in entries)
        sums = "".join(f"{digest}  {name}\n" for image in written for name, digest in image.sums)
        write_whole(partial / "ground_truth.csv", text.getvalue())
        write_whole(partial / "gt.txt", truths)
        write_whole(partial / "SHA256SUMS", sums)
        write_whole(partial / "dataset.json", description.model_dump_json(indent=2) + "\n")
    return open_dataset(folder)


def libraries() -> dict[str, str]:
    """Return the versions of what decodes sources and encodes images: other versions may give other bytes."""
    versions = {
        name: importlib.metadata.version(name) for name in ("numpy", "OpenImageIO", "opencv-contrib-python-headless")
    }
    return {**versions, "zlib": zlib.ZLIB_RUNTIME_VERSION}


def software() -> str:
    """Return name and version of this program."""
    return f"croplab {importlib.metadata.version('croplab')}"


def preview_of(image: npt.NDArray[np.uint16], white_level: int, side: int = PREVIEW_SIDE) -> Picture:
    """Return the raw look of an image: made small, then tone mapped; colours are the camera's and the light's.

    Parameters
    ----------
    image
        (H, W, 3) uint16, linear camera RGB.
    white_level
        Value of saturation.
    side
        Longest side allowed, px.

    Returns
    -------
    ndarray
        (h, w, 3) uint8.
    """
    import cv2

    from generator.tonemap import flash

    linear = image.astype(np.float32) / np.float32(white_level)
    height, width = image.shape[:2]
    scale = side / max(height, width)
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        linear = np.asarray(cv2.resize(linear, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    return flash(linear)


def check_free(folder: Path) -> None:
    """Raise an InputError if `folder` is taken, so that a command can say so before it does any work."""
    require_free(folder, "the dataset")


def default_workers() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_image(
    lut: Lut,
    partial: Path,
    name: str,
    source: str,
    picture: Picture,
    light: int,
    seed: int,
    number: int,
    form: ImageFormat,
    previews: bool,
) -> _Written:
    from generator.encode import encode_image, encode_preview
    from generator.kernel import draw_samples, read_light

    samples = read_light(lut, light, picture.shape[0] * picture.shape[1])
    image = draw_samples(samples, picture, seed=seed, image=number)
    sums: list[tuple[str, str]] = []

    def store(path: str, data: bytes) -> None:
        write_whole(partial / path, data)
        sums.append((path, hashlib.sha256(data).hexdigest()))

    store(f"images/{name}.{form}", encode_image(image, form))
    if previews:
        store(f"previews/{name}.jpg", encode_preview(preview_of(image, lut.provenance.white_level)))
    red, green, blue = (float(part) for part in lut.ground_truth[light])
    return _Written(Entry(f"{name}.{form}", source, light, (red, green, blue)), tuple(sums))


def _table_of(lut: Lut) -> Table:
    known = lut.provenance
    return Table(
        sha256=lut.sha256,
        camera=known.camera,
        bits=known.bits,
        samples=lut.samples.shape[2],
        white_level=known.white_level,
        software=known.software,
    )


def _light_of(lut: Lut, light: int) -> Light:
    shown = lut.illuminations[light]
    red, green, blue = (float(part) for part in lut.white[light])
    return Light(
        illumination=light,
        kind=shown.kind,
        cct_k=shown.cct_k,
        codes=(shown.colour.red, shown.colour.green, shown.colour.blue),
        white=(red, green, blue),
    )
