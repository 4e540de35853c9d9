"""NUS 8 cameras: 1736 images of the same scenes with eight cameras, a chart in each; a ninth, NikonD40, has 117 more.

    CAMERA/CAMERA_gt.mat      groundtruth_illuminants (N, 3), darkness_level, saturation_level, CC_coords (N, 4),
                              all_image_names (N,)
    CAMERA/CAMERA_0001.PNG    16 bits, demosaiced raw; also in CAMERA/PNG, or for all cameras in images/ and the .mat
                              files in ground_truth/
    CAMERA/CHECKER            the chart's box as text, see `charts`; used where there are no CC_coords, else
                              held against them

D. Cheng, D. Prasad, M. Brown, "Illuminant estimation for color constancy: why spatial-domain methods work and the role
of the color distribution", JOSA A 31(5), 2014; its page, cvil.eecs.yorku.ca/projects/public_html/illuminant. Levels are
in the units of the files, black not subtracted; `CC_coords` are first and last row, first and last column of the chart,
counted from 1, as internal/ReadImage.m of github.com/google/ffcc uses them. Not verified against a real copy; a `.mat`
of another version that lacks `all_image_names` is taken in the order of the file names.

The first line of `CAMERA/CHECKER/CAMERA_0001_mask.txt` is x,y,width,height of the chart; the folder is what the
archives MASK unpack to, and may also lie in that of all cameras. What the line means is told in
github.com/mahmoudnafifi/WB_sRGB, issue 15, whose author worked in the data set's laboratory: a rectangle for MATLAB's
`imcrop`, so px counted from 1, whose last row and column are round(y + height) and round(x + width).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from evaluation.datasets.files import Folder, Mask, RawScene, box_mask, check_light, numbers_in, present, read_text
from evaluation.datasets.options import DataOptions, choose, stated
from evaluation.datasets.published.matlab import read_mat, scalar, strings, table
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, first_few

# First and last row, first and last column of a chart, px counted from 1, both ends included.
Box = tuple[int, int, int, int]

_COORDS = "CC_coords"
_MASKS = "CHECKER"
# Share of their union that two boxes of one chart have in common at least. Margins around a chart may differ from
# source to source; boxes counted from another corner, of a turned image or with rows and columns in each other's
# place meet less.
_ALIKE = 0.5


def charts(
    content: Mapping[str, Any], path: Path, names: Sequence[str], kept: Sequence[int], root: Folder
) -> tuple[dict[int, Box], str]:
    """Return the chart's box in each of the images that are kept, and a sentence on where it was found."""
    masks = _mask_files(path, root)
    if _COORDS not in content:
        missing = [names[number] for number in kept if names[number] not in masks]
        if missing:
            raise FormatError(
                f"{path} has no {_COORDS}, and {len(missing)} of its images have no {_MASKS}/…_mask.txt "
                f"({first_few(missing)}), expected the chart of every image in one of them; fetch GROUNDTRUTH or MASK "
                "from the data set's page"
            )
        read = {number: read_mask(masks[names[number]]) for number in kept}
        return read, f"{_MASKS}/…_mask.txt, first line, as the .mat has no {_COORDS}"
    rows = table(content, _COORDS, path, 4).astype(int)
    if len(rows) != len(names):
        raise FormatError(f"{path} has {len(names)} images and {len(rows)} {_COORDS}, expected as many; restore it")
    boxes: dict[int, Box] = {}
    apart, compared = 0, 0
    for number in kept:
        top, bottom, left, right = (int(value) for value in rows[number])
        boxes[number] = (top, bottom, left, right)
        mask = masks.get(names[number])
        if mask is None:
            continue
        other = read_mask(mask)
        if overlap(boxes[number], other) < _ALIKE:
            raise FormatError(
                f"{mask} has the chart of {names[number]} in {_named(other)}, but {_COORDS} of {path}, row "
                f"{number + 1}, in {_named(boxes[number])}, expected the same chart in both; restore the one that is "
                f"wrong, or move {_MASKS} away to use the .mat alone"
            )
        compared += 1
        apart = max(apart, *(abs(one - two) for one, two in zip(boxes[number], other, strict=True)))
    source = f"{_COORDS} of the .mat, rows and columns counted from 1, both ends included"
    if compared:
        source += f" ({compared} of {len(kept)} held against {_MASKS}/…_mask.txt: edges at most {apart} px apart)"
    return boxes, source


def read_mask(path: Path) -> Box:
    """Return the chart's box of a text file."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    values = numbers_in(lines[0], f"{path}, line 1") if lines else []
    if len(values) != 4 or not math.isfinite(sum(map(abs, values))) or min(values[2:]) <= 0:
        raise FormatError(
            f"{path}, line 1: {lines[0].strip() if lines else 'nothing'!r} is no box of a chart, expected x, y, width "
            "and height in px; restore the file from the archive MASK"
        )
    x, y, width, height = values
    return _rounded(y), _rounded(y + height), _rounded(x), _rounded(x + width)


def overlap(one: Box, other: Box) -> float:
    """Return the area that two boxes have in common as a share of the area that either covers, 0 … 1.

    Examples
    --------
    >>> overlap((1, 10, 1, 10), (1, 10, 6, 15))
    0.3333333333333333
    >>> overlap((1, 10, 1, 10), (11, 20, 1, 10))
    0.0
    """
    common = _area((max(one[0], other[0]), min(one[1], other[1]), max(one[2], other[2]), min(one[3], other[3])))
    return common / max(_area(one) + _area(other) - common, 1)


def _area(box: Box) -> int:
    return max(box[1] - box[0] + 1, 0) * max(box[3] - box[2] + 1, 0)


def _rounded(value: float) -> int:
    """Return a value rounded as MATLAB does, halves away from 0; what lies before the image is its first pixel."""
    return max(math.floor(value + 0.5), 1)


def _named(box: Box) -> str:
    return f"rows {box[0]} to {box[1]} and columns {box[2]} to {box[3]}"


def _mask_files(path: Path, root: Folder) -> dict[str, Path]:
    """Return the text files of masks by the names of their images: beside the .mat, else in the folder of all."""
    for place in (Folder(path.parent), root):
        for name, below in place.folders.items():
            if name.upper() == _MASKS:
                ending = "_mask.txt"
                return {file[: -len(ending)]: below.path / file for file in below.files if file.endswith(ending)}
    return {}


_ENDING = "_gt.mat"
# By how many px a chart's box may go over the edge of its image, px: what rounding and counting from 0 can make.
_OVER = 2
# Images of each camera, as the list of ground truths in github.com/TheZino/COCOA has them.
_PUBLISHED: Final = {
    "Canon1DsMkIII": 259,
    "Canon600D": 200,
    "FujifilmXM1": 196,
    "NikonD5200": 200,
    "OlympusEPL6": 208,
    "PanasonicGX1": 203,
    "SamsungNX2000": 202,
    "SonyA57": 268,
    "NikonD40": 117,
}


@dataclass(frozen=True, slots=True)
class ChartScene(RawScene):
    """An image with the box of its chart.

    `box`: first and last row, first and last column of the chart, counted from 1.
    """

    box: Box = (1, 1, 1, 1)

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True in the box of the chart, of an image (H, W, 3)."""
        top, bottom, left, right = self.box
        height, width = image.shape[:2]
        over = max(-top, -left, bottom - height, right - width)
        if over > _OVER or not (0 < bottom >= top <= height and 0 < right >= left <= width):
            raise FormatError(
                f"{self.path} is {width} × {height}, but its chart is in rows {top} to {bottom} and columns {left} to "
                f"{right}; use the original files"
            )
        return box_mask((height, width), slice(max(top - 1, 0), bottom), slice(max(left - 1, 0), right))


def is_nus8(folder: Folder) -> bool:
    """Return whether a folder looks like the data set or one of its cameras: `CAMERA_gt.mat` in it or below."""
    return any(True for _ in _tables(folder))


def open_nus8(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return the images of all cameras in a folder, or of one; they are read when they are used."""
    folder = listed or Folder(Path(place))
    tables = {path.name[: -len(_ENDING)]: path for path in _tables(folder)}
    if not tables:
        raise FormatError(f"{place} has no CAMERA{_ENDING}, expected one a camera; fetch GROUNDTRUTH from its page")
    camera = choose(options.camera, tables, "camera", place)
    scenes: list[RawScene] = []
    notes: list[str] = []
    blacks: list[str] = []
    whites: list[str] = []
    sources: dict[str, list[str]] = {}
    for name, path in tables.items():
        if camera in (None, name):
            found, note, (black, white), source = _open_camera(folder, name, path, options)
            scenes.extend(found)
            published = _PUBLISHED.get(name, len(found))
            of = "" if len(found) == published else f" (published: {published})"
            notes.append(f"{name} {note}{of}")
            blacks.append(f"{name} {black:g}")
            whites.append(f"{name} {white:g}")
            sources.setdefault(source, []).append(name)
    return SceneSet(
        name=f"NUS {camera}" if camera else ("NUS 8" if len(tables) > 1 else f"NUS {next(iter(tables))}"),
        layout="nus8",
        location=place,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(notes),
            "black level": stated(
                options.black, f"darkness_level of the camera's .mat, subtracted: {', '.join(blacks)}"
            ),
            "saturation": stated(
                options.saturation, f"from saturation_level of the camera's .mat: {', '.join(whites)}"
            ),
            "mask": "the chart: "
            + "; ".join(f"of {', '.join(of)} by {how}" if len(sources) > 1 else how for how, of in sources.items()),
            "ground truth": "groundtruth_illuminants of the .mat",
        },
    )


def _tables(folder: Folder) -> Iterator[Path]:
    for place in folder.within(1):
        yield from (place.path / name for name in place.files if name.endswith(_ENDING) and len(name) > len(_ENDING))


def _open_camera(
    root: Folder, camera: str, path: Path, options: DataOptions
) -> tuple[list[RawScene], str, tuple[float, float], str]:
    """Return the scenes of a camera, a note on their number, black and white level, and the charts' source."""
    content = read_mat(path)
    lights = table(content, "groundtruth_illuminants", path, 3)
    folder, images = _images(root, camera, path)
    names = strings(content, "all_image_names", path)
    if names is None:
        names = list(images)
    if len(names) != len(lights):
        raise FormatError(
            f"{path} has {len(lights)} lights for {len(names)} images of {camera} in {folder}, expected as many: "
            "without all_image_names in the .mat the images are taken in the order of their names; complete the copy"
        )
    kept, note = present(names, images, path.name, folder, options.partial)
    boxes, source = charts(content, path, names, kept, root)
    black = scalar(content, "darkness_level", path) if options.black is None else options.black
    white = scalar(content, "saturation_level", path) if options.saturation is None else options.saturation
    if white <= black:
        raise FormatError(f"{path}: saturation {white:g} is not above black {black:g}; correct or give the levels")
    scenes: list[RawScene] = [
        ChartScene(
            names[number],
            images[names[number]],
            check_light(lights[number].tolist(), f"{path}, row {number + 1} of groundtruth_illuminants"),
            black,
            white,
            boxes[number],
        )
        for number in kept
    ]
    return scenes, note, (black, white), source


def _images(root: Folder, camera: str, path: Path) -> tuple[Path, dict[str, str]]:
    beside = Folder(path.parent)
    places = [beside, *(beside.folders.get(name) for name in ("PNG", "png")), root.folders.get("images")]
    for place in places:
        images = {} if place is None else place.images()
        images = {name: file for name, file in images.items() if name.startswith(f"{camera}_")}
        if place is not None and images:
            return place.path, images
    raise FormatError(
        f"there is no image {camera}_….PNG beside {path}, in PNG there or in {root.path / 'images'}; unpack the "
        "archives of PNG files there"
    )
