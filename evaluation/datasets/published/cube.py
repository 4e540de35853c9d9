"""Read Cube, Cube+, Cube++ and SimpleCube++: images of two Canon cameras with a SpyderCube in the lower right corner.

Cube and Cube+: 1365 and 1707 images of a Canon EOS 550D.

    cube+_gt.txt         r g b per line; line N is the ground truth of image N (cube_gt.txt: Cube)
    cube+_left_gt.txt    ground truths of the left and right grey face of the SpyderCube, optional
    cube+_right_gt.txt
    1.PNG … 1707.PNG     16 bits, half-size demosaiced raw, 2601 × 1732; in the same folder, or in folders PNG…

N. Banić, K. Koščević, S. Lončarić, "Unsupervised learning for color constancy", arXiv:1712.00436, and the data set's
page, ipg.fer.hr/ipg/resources/color_constancy. The black level is 2048; the lower right rectangle from row 1050 and
column 2050 is masked; `Peaks` gives the saturation. Four public preprocessing programs use the same layout, black level
and rectangle. Not verified against a real copy.

Cube++ and SimpleCube++: 4890 images of Canon EOS 550D and 600D, and 2234 of them at a quarter of height and width.

    gt.csv            image, then r, g, b of mean, left, right, left_white, right_white (mean_r …), r + g + b = 1
    properties.csv    image contents, and MakerNotes:NormalWhiteLevel; optional
    PNG/00_0001.png   16 bits, half-size demosaiced raw, 2592 × 1728 (other folders PNG… are read too)

    train/gt.csv, test/gt.csv      image,r,g,b: the mean of both grey faces
    train/PNG/…, test/PNG/…        648 × 432, the means of 4 × 4 px, the SpyderCube painted over with zeros

E. Ershov et al., "The Cube++ illumination estimation dataset", IEEE Access 8, 2020 (arXiv:2011.10028), and
github.com/Visillect/CubePlusPlus: description/description.md for layout, levels and ground truths,
code/build_simple_ds.py for the rectangle of the SpyderCube. Not verified against a real copy.
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
    gather_images,
    match_images,
    parse_light,
    parse_number,
    read_lights,
    read_rows,
)
from evaluation.datasets.options import DataOptions, choose_name, level_note
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, InputError

BELOW_PEAK = 2  # values up to this number of counts below the largest value are clipped, see `Peaks`

# Text in results that describes the rule of `Peaks`.
PEAK_RULE = (
    "from m - 2, where m is the largest value in any channel of the image (advice of the authors of Cube+, "
    "ipg.fer.hr/ipg/resources/color_constancy)"
)


@dataclass(frozen=True)
class Peaks:
    """Cache of the largest values of images, from which saturation levels are derived.

    The authors of Cube and Cube+ advise to discard all pixels with a channel of m - 2 or more, where m is the largest
    value of the image. Their page was not accessible, but two public preprocessing programs apply this rule.
    """

    _values: dict[str, float] = field(default_factory=dict[str, float])

    def record(self, path: str, image: Image) -> None:
        """Record the largest value of an image (H, W, 3) of any dtype, unchanged from its file."""
        self._values[path] = float(np.max(image))

    def value(self, path: str) -> float:
        """Return the largest value of an image file, which is read if necessary."""
        if path not in self._values:
            self.record(path, decode_image(path))
        return self._values[path]


@dataclass(frozen=True, slots=True)
class PeakScene(RawScene):
    """Image whose saturation is derived from its largest value if `white` is None; `peaks` is shared by all images."""

    peaks: Peaks = field(default_factory=Peaks)

    @property
    def saturation(self) -> float:
        """Saturation level minus black level; reads the image if necessary."""
        white = self.peaks.value(self.path) - BELOW_PEAK if self.white is None else self.white
        return white - self.black

    def decode(self) -> Image:
        """Return the unchanged values of the file, (H, W, 3)."""
        image = decode_image(self.path)
        if self.white is None:
            self.peaks.record(self.path, image)
        return image


# Black level of all files, from the data set's page. The source for Cube++ is description.md ("approximately 2048").
BLACK = 2048
# Upper left corner of the masked rectangle, which extends to the lower right corner, px; the data set's page.
CUBE_ROW, CUBE_COLUMN = 1050, 2050

# Name and number of images of each data set, by its file of ground truths; arXiv:1712.00436.
_PUBLISHED_CUBES = {"cube+_gt.txt": ("Cube+", 1707), "cube_gt.txt": ("Cube", 1365)}


@dataclass(frozen=True, slots=True)
class CubePlusScene(PeakScene):
    """Image of Cube or Cube+."""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool for an image (H, W, 3), True in the rectangle of the SpyderCube."""
        height, width = image.shape[:2]
        if height <= CUBE_ROW or width <= CUBE_COLUMN:
            raise FormatError(
                f"{self.path} is {width} × {height}, expected 2601 × 1732: the SpyderCube is masked from row "
                f"{CUBE_ROW} and column {CUBE_COLUMN}; use the original files, or a folder of images with a CSV"
            )
        return box_mask((height, width), slice(CUBE_ROW, None), slice(CUBE_COLUMN, None))


def is_cube_plus(folder: Folder) -> bool:
    """Return True if a folder has the ground truths of Cube or Cube+."""
    return any(folder.has(name) for name in _PUBLISHED_CUBES)


def open_cube_plus(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return Cube+ or Cube; images are read on use."""
    folder = scanned_folder or Folder(Path(location))
    file = next((name for name in _PUBLISHED_CUBES if folder.has(name)), None)
    if file is None:
        raise FormatError(f"{location} has no cube+_gt.txt, expected Cube+; download it from the data set's page")
    name, published = _PUBLISHED_CUBES[file]
    faces = {face: folder.path / file.replace("_gt", f"_{face}_gt") for face in ("left", "right")}
    truths = {"own": folder.path / file} | {face: path for face, path in faces.items() if path.is_file()}
    truth = choose_name(options.truth, truths, "truth", location) or "own"
    lights = read_lights(truths[truth])
    png_folders = [child for name, child in folder.folders.items() if name.upper().startswith("PNG")]
    images = gather_images([folder, *png_folders])
    searched = f"{folder.path} (with folders PNG…: {', '.join(below.path.name for below in png_folders) or 'none'})"
    names = [str(number) for number in range(1, len(lights) + 1)]
    indices, note = match_images(names, images, file, searched, options.partial)
    black = BLACK if options.black is None else options.black
    peaks = Peaks()
    return SceneSet(
        name=name,
        layout="cube-plus",
        location=location,
        scenes=tuple(
            CubePlusScene(f"{index + 1}.PNG", images[str(index + 1)], lights[index], black, options.saturation, peaks)
            for index in indices
        ),
        treatment={
            "images": note + ("" if len(indices) == published else f"; the published {name} has {published}"),
            "black level": level_note(options.black, f"{BLACK}, subtracted (the data set's page)"),
            "saturation": level_note(options.saturation, PEAK_RULE),
            "mask": f"the SpyderCube: rows from {CUBE_ROW} and columns from {CUBE_COLUMN} (the data set's page)",
            "ground truth": f"{truths[truth].name}" + ("" if truth == "own" else f", the {truth} face of the cube"),
        },
    )


SIZE = (1728, 2592)  # height and width of Cube++, px (description.md)
SIMPLE_SCALE = 4  # reduction of SimpleCube++ in both directions (code/build_simple_ds.py)
# Size of the rectangle with the SpyderCube in the lower right corner, px of Cube++ (code/build_simple_ds.py).
CUBE_HEIGHT, CUBE_WIDTH = 1000, 700

_TRUTHS = ("mean", "left", "right", "left_white", "right_white")
_PUBLISHED_COUNTS = {"Cube++": 4890, "SimpleCube++": 2234}
_WHITE_COLUMN = "MakerNotes:NormalWhiteLevel"
_SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True)
class CubePlusPlusScene(PeakScene):
    """Image of Cube++ or SimpleCube++; `scale` is its reduction in both directions, 1 or 4."""

    scale: int = 1

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool for an image (H, W, 3), True in the rectangle of the SpyderCube."""
        height, width = (side // self.scale for side in SIZE)
        if image.shape[:2] != (height, width):
            raise FormatError(
                f"{self.path} is {image.shape[1]} × {image.shape[0]}, expected {width} × {height} to mask the "
                "SpyderCube; use the original files, or a folder of images with a CSV"
            )
        rows = slice(height - CUBE_HEIGHT // self.scale, None)
        return box_mask((height, width), rows, slice(width - CUBE_WIDTH // self.scale, None))


def is_cube_plus_plus(folder: Folder) -> bool:
    """Return True if a folder has the `gt.csv` of Cube++, with the faces of the SpyderCube."""
    return folder.has("gt.csv") and "left_r" in _first_line(folder.path / "gt.csv")


def is_simple_cube(folder: Folder) -> bool:
    """Return True if a folder, or its `train` or `test`, has a `gt.csv` and a folder `PNG` but is not Cube++."""
    if _is_split(folder):
        return not is_cube_plus_plus(folder)
    return any(_is_split(folder.folders[split]) for split in _SPLITS if split in folder.folders)


def open_cube_plus_plus(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return Cube++; images are read on use."""
    folder = scanned_folder or Folder(Path(location))
    truth = choose_name(options.truth, _TRUTHS, "truth", location) or "mean"
    lights: dict[str, Light] = {}
    names: list[str] = []
    columns = [f"{truth}_{channel}" for channel in "rgb"]
    for origin, row in read_rows(folder.path / "gt.csv", ["image", *columns]):
        names.append(row["image"])
        if not _is_blank(row, columns):
            lights[row["image"]] = parse_light(row, columns, origin)
    png_folders = [child for name, child in folder.folders.items() if name.upper().startswith("PNG")]
    images = gather_images(png_folders)
    indices, note = match_images(names, images, "gt.csv", folder.path / "PNG", options.partial)
    without_truth_count = len([index for index in indices if names[index] not in lights])
    if without_truth_count == len(indices):
        raise InputError(f"{location}: no image has the ground truth {truth!r}; choose another with --read truth=NAME")
    whites = _white_levels(folder.path / "properties.csv") if folder.has("properties.csv") else {}
    black, peaks = BLACK if options.black is None else options.black, Peaks()
    scenes = tuple(
        CubePlusPlusScene(
            f"{name}.png", images[name], lights[name], black, options.saturation or whites.get(name), peaks
        )
        for name in (names[index] for index in indices)
        if name in lights
    )
    if without_truth_count:
        note += (
            f"; {without_truth_count} of these have no {truth} and are excluded (the authors give a mean "
            "if both grey faces agree within 1° and are bright enough)"
        )
    return SceneSet(
        name="Cube++",
        layout="cube++",
        location=location,
        scenes=scenes,
        treatment={
            "images": note + _published_note("Cube++", len(indices)),
            "black level": level_note(options.black, f"{BLACK}, subtracted (description.md of the data set)"),
            "saturation": level_note(
                options.saturation,
                f"from {_WHITE_COLUMN} of properties.csv, image by image (description.md)" if whites else PEAK_RULE,
            ),
            "mask": f"the SpyderCube: the lower right {CUBE_WIDTH} × {CUBE_HEIGHT} px (code/build_simple_ds.py)",
            "ground truth": f"{truth} of gt.csv",
        },
    )


def open_simple_cube(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return SimpleCube++, or its subset `train` or `test`; images are read on use."""
    folder = scanned_folder or Folder(Path(location))
    splits = [folder.folders[name] for name in _SPLITS if name in folder.folders and _is_split(folder.folders[name])]
    if _is_split(folder):
        splits = [folder]
    if not splits:
        raise FormatError(f"{location} has no train/gt.csv and train/PNG, expected SimpleCube++; complete it")
    subset = choose_name(options.subset, [split.path.name for split in splits], "subset", location)
    black, peaks, notes = BLACK if options.black is None else options.black, Peaks(), list[str]()
    scenes: list[CubePlusPlusScene] = []
    for split in splits:
        if subset not in (None, split.path.name):
            continue
        rows = [
            (row["image"], parse_light(row, "rgb", origin))
            for origin, row in read_rows(split.path / "gt.csv", ["image", "r", "g", "b"])
        ]
        images = split.folders["PNG"].images()
        source = f"{split.path.name}/gt.csv"
        indices, note = match_images([name for name, _ in rows], images, source, split.path / "PNG", options.partial)
        notes.append(f"{split.path.name} {note}")
        scenes.extend(
            CubePlusPlusScene(f"{name}.png", images[name], light, black, options.saturation, peaks, SIMPLE_SCALE)
            for name, light in (rows[index] for index in indices)
        )
    return SceneSet(
        name="SimpleCube++",
        layout="simple-cube++",
        location=location,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(notes) + _published_note("SimpleCube++", len(scenes)),
            "black level": level_note(options.black, f"{BLACK}, subtracted (description.md of the data set)"),
            "saturation": level_note(
                options.saturation, PEAK_RULE + "; partly clipped blocks of 4 × 4 px cannot be detected"
            ),
            "mask": f"the SpyderCube, painted over: the lower right {CUBE_WIDTH // SIMPLE_SCALE} × "
            f"{CUBE_HEIGHT // SIMPLE_SCALE} px (description.md)",
            "ground truth": "r, g, b of gt.csv: the mean of both grey faces",
        },
    )


def _is_split(folder: Folder) -> bool:
    return "PNG" in folder.folders and folder.has("gt.csv")


def _first_line(path: Path) -> list[str]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            return [name.strip() for name in file.readline().split(",")]
    except (OSError, UnicodeDecodeError):
        return []


def _is_blank(row: Mapping[str, str], columns: Sequence[str]) -> bool:
    # Missing values may be written as NaN, for example by pandas.
    return all(row[column].strip().lower() in ("", "nan") for column in columns)


def _white_levels(path: Path) -> dict[str, float]:
    levels: dict[str, float] = {}
    for origin, row in read_rows(path, ["image"]):
        text = row.get(_WHITE_COLUMN, "").strip()
        if text:
            level = parse_number(text, origin, _WHITE_COLUMN)
            if not (math.isfinite(level) and level > BLACK):
                raise FormatError(f"{origin}: {_WHITE_COLUMN} is {text}, expected above black, {BLACK}; restore it")
            levels[row["image"]] = level
    return levels


def _published_note(name: str, count: int) -> str:
    return "" if count == _PUBLISHED_COUNTS[name] else f"; the published {name} has {_PUBLISHED_COUNTS[name]}"
