"""Cube, Cube+, Cube++ and SimpleCube++: images of two Canon cameras with a SpyderCube in their lower right corner.

Cube and Cube+: 1365 and 1707 images of a Canon EOS 550D with a SpyderCube in their lower right corner.

    cube+_gt.txt         r g b a line; line N is the light of image N (cube_gt.txt: Cube)
    cube+_left_gt.txt    the same of the left and right grey face of the SpyderCube, optional
    cube+_right_gt.txt
    1.PNG … 1707.PNG     16 bits, half-size demosaiced raw, 2601 × 1732; beside it, or in folders PNG…

N. Banić, K. Koščević, S. Lončarić, "Unsupervised learning for color constancy", arXiv:1712.00436, and the data set's
page, ipg.fer.hr/ipg/resources/color_constancy: black 2048 is to be subtracted, the calibration cube is masked by
leaving out the lower right rectangle from row 1050 and column 2050, and clipped pixels as `Peaks` says. Layout, black
level and rectangle were held against four public preprocessing programs; not verified against a real copy.

Cube++ and SimpleCube++: 4890 images of Canon EOS 550D and 600D, and 2234 of them reduced four times.

    gt.csv            image, then r, g, b of mean, left, right, left_white, right_white (mean_r …), r + g + b = 1
    properties.csv    of each image what it shows, and MakerNotes:NormalWhiteLevel; optional
    PNG/00_0001.png   16 bits, half-size demosaiced raw, 2592 × 1728 (more folders PNG… are taken too)

    train/gt.csv, test/gt.csv      image,r,g,b: the mean of both grey faces
    train/PNG/…, test/PNG/…        648 × 432, the means of 4 × 4 px, the cube painted over with zeros

E. Ershov et al., "The Cube++ illumination estimation dataset", IEEE Access 8, 2020 (arXiv:2011.10028), and
github.com/Visillect/CubePlusPlus: description/description.md for layout, levels and truths, code/build_simple_ds.py for
the rectangle that holds the SpyderCube (the lower right 700 × 1000 px). Not verified against a real copy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from evaluation.datasets.files import (
    Folder,
    Light,
    Mask,
    RawScene,
    box_mask,
    decode_image,
    gather,
    light_of,
    number_of,
    present,
    read_lights,
    read_rows,
)
from evaluation.datasets.options import DataOptions, choose, stated
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, InputError

BELOW_PEAK = 2  # The authors' advice, see above: the two values below an image's largest count as clipped too

# The rule in the words of a treatment.
PEAK_RULE = (
    "in each image from m - 2, m its largest value in any channel (advice of the authors of Cube+, "
    "ipg.fer.hr/ipg/resources/color_constancy)"
)


@dataclass(frozen=True)
class Peaks:
    """The largest values of images that were read, so that asking for a saturation reads none a second time.

    They are the threshold of clipping where a data set states no other. The authors of Cube and Cube+ looked at
    histograms of their images and advise, for an image whose largest value in any channel is m, to discard every pixel
    with a channel from m - 2. (Their page itself was not at hand; two independent public preprocessing programs apply
    this rule.)
    """

    _known: dict[str, float] = field(default_factory=dict[str, float])

    def learn(self, path: str, image: Image) -> None:
        """Keep the largest value of an image (H, W, 3) of any dtype, as it is in its file."""
        self._known[path] = float(np.max(image))

    def of(self, path: str) -> float:
        """Return the largest value of the image in a file, which is read if it was not before."""
        if path not in self._known:
            self.learn(path, decode_image(path))
        return self._known[path]


@dataclass(frozen=True, slots=True)
class PeakScene(RawScene):
    """An image whose saturation is taken from its own largest value unless `white` is given.

    `peaks`: of all images of the data set.
    """

    peaks: Peaks = field(default_factory=Peaks)

    @property
    def saturation(self) -> float:
        """Value from which a pixel is clipped, in the units that `read` gives; reads the image if nothing did yet."""
        white = self.peaks.of(self.path) - BELOW_PEAK if self.white is None else self.white
        return white - self.black

    def decoded(self) -> Image:
        """Return the image (H, W, 3) as the file's numbers are."""
        image = decode_image(self.path)
        if self.white is None:
            self.peaks.learn(self.path, image)
        return image


# Black level of all files: the data set's page; of Cube++ "approximately 2048, not subtracted" (description.md).
BLACK = 2048
# From where the calibration cube's rectangle reaches to the lower right corner, px; the data set's page.
CUBE_ROW, CUBE_COLUMN = 1050, 2050

# Name and number of images by the file of ground truths; arXiv:1712.00436.
_OWN = {"cube+_gt.txt": ("Cube+", 1707), "cube_gt.txt": ("Cube", 1365)}


@dataclass(frozen=True, slots=True)
class CubePlusScene(PeakScene):
    """An image of Cube or Cube+."""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True in the rectangle of the cube, of an image (H, W, 3)."""
        height, width = image.shape[:2]
        if height <= CUBE_ROW or width <= CUBE_COLUMN:
            raise FormatError(
                f"{self.path} is {width} × {height}, expected 2601 × 1732: the calibration cube is masked from row "
                f"{CUBE_ROW} and column {CUBE_COLUMN}; use the original files, or a folder of images with a CSV"
            )
        return box_mask((height, width), slice(CUBE_ROW, None), slice(CUBE_COLUMN, None))


def is_cube_plus(folder: Folder) -> bool:
    """Return whether a folder looks like Cube or Cube+."""
    return any(folder.has(name) for name in _OWN)


def open_cube_plus(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return Cube+ or Cube; images are read when they are used."""
    folder = listed or Folder(Path(place))
    file = next((name for name in _OWN if folder.has(name)), None)
    if file is None:
        raise FormatError(f"{place} is no copy of Cube+: it has no cube+_gt.txt; fetch it from the data set's page")
    name, published = _OWN[file]
    faces = {face: folder.path / file.replace("_gt", f"_{face}_gt") for face in ("left", "right")}
    truths = {"own": folder.path / file} | {face: path for face, path in faces.items() if path.is_file()}
    truth = choose(options.truth, truths, "truth", place) or "own"
    lights = read_lights(truths[truth])
    parts = [part for part_name, part in folder.folders.items() if part_name.upper().startswith("PNG")]
    images = gather([folder, *parts])
    looked = f"{folder.path} (itself and its folders PNG…: {', '.join(part.path.name for part in parts) or 'none'})"
    kept, note = present([str(number) for number in range(1, len(lights) + 1)], images, file, looked, options.partial)
    black = BLACK if options.black is None else options.black
    peaks = Peaks()
    return SceneSet(
        name=name,
        layout="cube-plus",
        location=place,
        scenes=tuple(
            CubePlusScene(
                f"{number + 1}.PNG", images[str(number + 1)], lights[number], black, options.saturation, peaks
            )
            for number in kept
        ),
        treatment={
            "images": note + ("" if len(kept) == published else f"; the published {name} has {published}"),
            "black level": stated(options.black, f"{BLACK}, subtracted (the data set's page)"),
            "saturation": stated(options.saturation, PEAK_RULE),
            "mask": f"the calibration cube: rows from {CUBE_ROW} and columns from {CUBE_COLUMN} (the data set's page)",
            "ground truth": f"{truths[truth].name}" + ("" if truth == "own" else f", the {truth} face of the cube"),
        },
    )


SIZE = (1728, 2592)  # Height and width of Cube++, px (description.md)
SIMPLE_SCALE = 4  # How often SimpleCube++ is reduced (code/build_simple_ds.py)
# The rectangle with the SpyderCube, from the lower right corner, px of Cube++ (code/build_simple_ds.py).
CUBE_HEIGHT, CUBE_WIDTH = 1000, 700

_TRUTHS = ("mean", "left", "right", "left_white", "right_white")
_PUBLISHED = {"Cube++": 4890, "SimpleCube++": 2234}
_WHITE = "MakerNotes:NormalWhiteLevel"
_SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True)
class CubePlusPlusScene(PeakScene):
    """An image of Cube++ or SimpleCube++.

    `scale`: how often it is reduced, 1 or 4.
    """

    scale: int = 1

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True in the rectangle of the SpyderCube, of an image (H, W, 3)."""
        height, width = (side // self.scale for side in SIZE)
        if image.shape[:2] != (height, width):
            raise FormatError(
                f"{self.path} is {image.shape[1]} × {image.shape[0]}, expected {width} × {height}, in which the "
                "SpyderCube is masked; use the original files, or a folder of images with a CSV"
            )
        rows = slice(height - CUBE_HEIGHT // self.scale, None)
        return box_mask((height, width), rows, slice(width - CUBE_WIDTH // self.scale, None))


def is_cube_plus_plus(folder: Folder) -> bool:
    """Return whether a folder looks like Cube++: a `gt.csv` with the faces of the SpyderCube."""
    return folder.has("gt.csv") and "left_r" in _first_line(folder.path / "gt.csv")


def is_simple_cube(folder: Folder) -> bool:
    """Return whether a folder looks like SimpleCube++ or one of its parts: `gt.csv` beside a folder `PNG`."""
    if _is_part(folder):
        return not is_cube_plus_plus(folder)
    return any(_is_part(folder.folders[split]) for split in _SPLITS if split in folder.folders)


def open_cube_plus_plus(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return Cube++; images are read when they are used."""
    folder = listed or Folder(Path(place))
    truth = choose(options.truth, _TRUTHS, "truth", place) or "mean"
    lights: dict[str, Light] = {}
    names: list[str] = []
    columns = [f"{truth}_{channel}" for channel in "rgb"]
    for where, row in read_rows(folder.path / "gt.csv", ["image", *columns]):
        names.append(row["image"])
        if not _is_blank(row, columns):
            lights[row["image"]] = light_of(row, columns, where)
    parts = [part for name, part in folder.folders.items() if name.upper().startswith("PNG")]
    images = gather(parts)
    kept, note = present(names, images, "gt.csv", folder.path / "PNG", options.partial)
    without = len([number for number in kept if names[number] not in lights])
    if without == len(kept):
        raise InputError(f"no image of {place} has the ground truth {truth!r}; choose another with --read truth=NAME")
    whites = _white_levels(folder.path / "properties.csv") if folder.has("properties.csv") else {}
    black, peaks = BLACK if options.black is None else options.black, Peaks()
    scenes = tuple(
        CubePlusPlusScene(
            f"{name}.png", images[name], lights[name], black, options.saturation or whites.get(name), peaks
        )
        for name in (names[number] for number in kept)
        if name in lights
    )
    if without:
        note += (
            f"; {without} of these have no {truth} and are left out (the authors give a mean where both grey faces "
            "agree within 1° and are bright enough)"
        )
    return SceneSet(
        name="Cube++",
        layout="cube++",
        location=place,
        scenes=scenes,
        treatment={
            "images": note + _of_published("Cube++", len(kept)),
            "black level": stated(options.black, f"{BLACK}, subtracted (description.md of the data set)"),
            "saturation": stated(
                options.saturation,
                f"from {_WHITE} of properties.csv, image by image (description.md)" if whites else PEAK_RULE,
            ),
            "mask": f"the SpyderCube: the lower right {CUBE_WIDTH} × {CUBE_HEIGHT} px (code/build_simple_ds.py)",
            "ground truth": f"{truth} of gt.csv",
        },
    )


def open_simple_cube(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return SimpleCube++, or its part `train` or `test`; images are read when they are used."""
    folder = listed or Folder(Path(place))
    splits = [folder.folders[name] for name in _SPLITS if name in folder.folders and _is_part(folder.folders[name])]
    if _is_part(folder):
        splits = [folder]
    if not splits:
        raise FormatError(f"{place} is no copy of SimpleCube++: it has no train/gt.csv beside train/PNG; complete it")
    subset = choose(options.subset, [split.path.name for split in splits], "subset", place)
    black, peaks, notes = BLACK if options.black is None else options.black, Peaks(), list[str]()
    scenes: list[CubePlusPlusScene] = []
    for split in splits:
        if subset not in (None, split.path.name):
            continue
        rows = [
            (row["image"], light_of(row, "rgb", where))
            for where, row in read_rows(split.path / "gt.csv", ["image", "r", "g", "b"])
        ]
        images = split.folders["PNG"].images()
        source = f"{split.path.name}/gt.csv"
        kept, note = present([name for name, _ in rows], images, source, split.path / "PNG", options.partial)
        notes.append(f"{split.path.name} {note}")
        scenes.extend(
            CubePlusPlusScene(f"{name}.png", images[name], light, black, options.saturation, peaks, SIMPLE_SCALE)
            for name, light in (rows[number] for number in kept)
        )
    return SceneSet(
        name="SimpleCube++",
        layout="simple-cube++",
        location=place,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(notes) + _of_published("SimpleCube++", len(scenes)),
            "black level": stated(options.black, f"{BLACK}, subtracted (description.md of the data set)"),
            "saturation": stated(
                options.saturation,
                PEAK_RULE + "; where a part only of the 4 × 4 px of a pixel was clipped, that cannot be seen",
            ),
            "mask": f"the SpyderCube, painted over: the lower right {CUBE_WIDTH // SIMPLE_SCALE} × "
            f"{CUBE_HEIGHT // SIMPLE_SCALE} px (description.md)",
            "ground truth": "r, g, b of gt.csv: the mean of both grey faces",
        },
    )


def _is_part(folder: Folder) -> bool:
    return "PNG" in folder.folders and folder.has("gt.csv")


def _first_line(path: Path) -> list[str]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            return [name.strip() for name in file.readline().split(",")]
    except (OSError, UnicodeDecodeError):
        return []


def _is_blank(row: Mapping[str, str], columns: Sequence[str]) -> bool:
    """Return whether an image has no such light: its fields are empty, or NaN as pandas writes them."""
    return all(row[column].strip().lower() in ("", "nan") for column in columns)


def _white_levels(path: Path) -> dict[str, float]:
    levels: dict[str, float] = {}
    for where, row in read_rows(path, ["image"]):
        text = row.get(_WHITE, "").strip()
        if text:
            level = number_of(text, where, _WHITE)
            if not (math.isfinite(level) and level > BLACK):
                raise FormatError(f"{where}: {_WHITE} is {text}, expected a level above black, {BLACK}; restore it")
            levels[row["image"]] = level
    return levels


def _of_published(name: str, count: int) -> str:
    return "" if count == _PUBLISHED[name] else f"; the published {name} has {_PUBLISHED[name]}"
