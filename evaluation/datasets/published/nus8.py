"""Read the NUS data set: 1736 images of the same scenes by eight cameras, and 117 by a ninth (NikonD40), with charts.

    CAMERA/CAMERA_gt.mat      groundtruth_illuminants (N, 3), darkness_level, saturation_level, CC_coords (N, 4),
                              all_image_names (N,)
    CAMERA/CAMERA_0001.PNG    16 bits, demosaiced raw; also read from CAMERA/PNG, or from images/ for all cameras (the
                              .mat files are then in ground_truth/)
    CAMERA/CHECKER            chart boxes as text; used if there are no CC_coords, else compared with CC_coords

D. Cheng, D. Prasad, M. Brown, "Illuminant estimation for color constancy: why spatial-domain methods work and the role
of the color distribution", JOSA A 31(5), 2014; cvil.eecs.yorku.ca/projects/public_html/illuminant. Levels are in the
units of the files, black not subtracted. `CC_coords` are first and last row, first and last column of the chart,
counted from 1, as used by internal/ReadImage.m of github.com/google/ffcc. Not verified against a real copy.

The first line of `CAMERA/CHECKER/CAMERA_0001_mask.txt` is x,y,width,height of the chart. The folder CHECKER comes from
the archives MASK; one folder CHECKER for all cameras is also read. Source: github.com/mahmoudnafifi/WB_sRGB, issue 15,
by a former member of the laboratory. The box is a rectangle for MATLAB's `imcrop`, in px counted from 1. Its last row
and column are round(y + height) and round(x + width).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from evaluation.datasets.files import Folder, Mask, RawScene, box_mask, check_light, match_images, read_text, to_numbers
from evaluation.datasets.options import DataOptions, choose_name, level_note
from evaluation.datasets.published.matlab import names_or_none, numeric_table, read_mat, scalar
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, first_few

# First and last row, first and last column of a chart, px counted from 1, both ends included.
Box = tuple[int, int, int, int]

_COORDS = "CC_coords"
_MASK_FOLDER = "CHECKER"
# Smallest intersection of two boxes of the same chart, fraction of their union. Boxes may have different margins. The
# intersection is below this limit if an image was rotated, or if rows and columns were exchanged.
_LEAST_OVERLAP = 0.5


def chart_boxes(
    content: Mapping[str, Any], path: Path, names: Sequence[str], indices: Sequence[int], root: Folder
) -> tuple[dict[int, Box], str]:
    """Return the chart box of each image by index, and a text with its source."""
    mask_files = _mask_files(path, root)
    if _COORDS not in content:
        missing = [names[index] for index in indices if names[index] not in mask_files]
        if missing:
            raise FormatError(
                f"{path} has no {_COORDS}, and {len(missing)} of its images have no {_MASK_FOLDER}/…_mask.txt "
                f"({first_few(missing)}), expected the chart of every image in one of them; download GROUNDTRUTH or "
                "MASK from the data set's page"
            )
        source = f"{_MASK_FOLDER}/…_mask.txt, first line, as the .mat has no {_COORDS}"
        return {index: read_mask(mask_files[names[index]]) for index in indices}, source
    rows = numeric_table(content, _COORDS, path, 4).astype(int)
    if len(rows) != len(names):
        raise FormatError(f"{path} has {len(names)} images and {len(rows)} {_COORDS}, expected one each; restore it")
    boxes: dict[int, Box] = {}
    max_difference, compared_count = 0, 0
    for index in indices:
        top, bottom, left, right = (int(value) for value in rows[index])
        boxes[index] = (top, bottom, left, right)
        mask_path = mask_files.get(names[index])
        if mask_path is None:
            continue
        mask_box = read_mask(mask_path)
        if overlap(boxes[index], mask_box) < _LEAST_OVERLAP:
            raise FormatError(
                f"{mask_path} has the chart of {names[index]} in {_describe_box(mask_box)}, but {_COORDS} of {path}, "
                f"row {index + 1}, in {_describe_box(boxes[index])}, expected overlapping boxes; restore the wrong "
                f"file, or remove {_MASK_FOLDER} to use only the .mat"
            )
        compared_count += 1
        differences = [abs(edge - mask_edge) for edge, mask_edge in zip(boxes[index], mask_box, strict=True)]
        max_difference = max(max_difference, *differences)
    source = f"{_COORDS} of the .mat, rows and columns counted from 1, both ends included"
    if compared_count:
        source += f" ({compared_count} of {len(indices)} as in {_MASK_FOLDER}/…_mask.txt, within {max_difference} px)"
    return boxes, source


def read_mask(path: Path) -> Box:
    """Return the chart box in a text file."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    values = to_numbers(lines[0], f"{path}, line 1") if lines else []
    if len(values) != 4 or not math.isfinite(sum(map(abs, values))) or min(values[2:]) <= 0:
        raise FormatError(
            f"{path}, line 1: {lines[0].strip() if lines else 'nothing'!r}, expected x, y, width and height of the "
            "chart in px; restore the file from the archive MASK"
        )
    x, y, width, height = values
    return _round_like_matlab(y), _round_like_matlab(y + height), _round_like_matlab(x), _round_like_matlab(x + width)


def overlap(a: Box, b: Box) -> float:
    """Return the intersection of two boxes as a fraction of their union, 0 … 1.

    Examples
    --------
    >>> overlap((1, 10, 1, 10), (1, 10, 6, 15))
    0.3333333333333333
    >>> overlap((1, 10, 1, 10), (11, 20, 1, 10))
    0.0
    """
    common = _area((max(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), min(a[3], b[3])))
    return common / max(_area(a) + _area(b) - common, 1)


def _area(box: Box) -> int:
    return max(box[1] - box[0] + 1, 0) * max(box[3] - box[2] + 1, 0)


def _round_like_matlab(value: float) -> int:
    # MATLAB rounds halves away from 0. Values below 1 become the first row or column.
    return max(math.floor(value + 0.5), 1)


def _describe_box(box: Box) -> str:
    return f"rows {box[0]} to {box[1]} and columns {box[2]} to {box[3]}"


def _mask_files(path: Path, root: Folder) -> dict[str, Path]:
    # The folder of the camera is preferred to the folder of all cameras.
    for searched_folder in (Folder(path.parent), root):
        for name, child in searched_folder.folders.items():
            if name.upper() == _MASK_FOLDER:
                ending = "_mask.txt"
                return {file[: -len(ending)]: child.path / file for file in child.files if file.endswith(ending)}
    return {}


_MAT_ENDING = "_gt.mat"
# A chart box may extend this far beyond the image edge, px. Rounding and counting from 0 instead of 1 cause up to 2 px.
_LARGEST_OVERHANG = 2
# Number of images of each camera, from the list of ground truths in github.com/TheZino/COCOA.
_PUBLISHED_COUNTS: Final = {
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
    """Image with the box of its chart: first and last row, first and last column, counted from 1."""

    box: Box = (1, 1, 1, 1)

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool for an image (H, W, 3), True in the box of the chart."""
        top, bottom, left, right = self.box
        height, width = image.shape[:2]
        overhang = max(-top, -left, bottom - height, right - width)
        if overhang > _LARGEST_OVERHANG or not (0 < bottom >= top <= height and 0 < right >= left <= width):
            raise FormatError(
                f"{self.path} is {width} × {height}, expected an image with the chart in rows {top} to {bottom} and "
                f"columns {left} to {right}; use the original files"
            )
        return box_mask((height, width), slice(max(top - 1, 0), bottom), slice(max(left - 1, 0), right))


def is_nus8(folder: Folder) -> bool:
    """Return True if a folder or a direct subfolder has a `CAMERA_gt.mat`."""
    return any(True for _ in _mat_files(folder))


def open_nus8(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the images of all cameras in a folder, or of the selected one; images are read on use."""
    folder = scanned_folder or Folder(Path(location))
    tables = {path.name[: -len(_MAT_ENDING)]: path for path in _mat_files(folder)}
    if not tables:
        raise FormatError(f"{location} has no CAMERA{_MAT_ENDING}; download GROUNDTRUTH from the data set's page")
    camera = choose_name(options.camera, tables, "camera", location)
    scenes: list[RawScene] = []
    notes: list[str] = []
    blacks: list[str] = []
    whites: list[str] = []
    sources: dict[str, list[str]] = {}
    for name, path in tables.items():
        if camera in (None, name):
            camera_scenes, note, (black, white), source = _open_camera(folder, name, path, options)
            scenes.extend(camera_scenes)
            published = _PUBLISHED_COUNTS.get(name, len(camera_scenes))
            published_note = "" if len(camera_scenes) == published else f" (published: {published})"
            notes.append(f"{name} {note}{published_note}")
            blacks.append(f"{name} {black:g}")
            whites.append(f"{name} {white:g}")
            sources.setdefault(source, []).append(name)
    return SceneSet(
        name=f"NUS {camera}" if camera else ("NUS 8" if len(tables) > 1 else f"NUS {next(iter(tables))}"),
        layout="nus8",
        location=location,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(notes),
            "black level": level_note(
                options.black, f"darkness_level of the camera's .mat, subtracted: {', '.join(blacks)}"
            ),
            "saturation": level_note(
                options.saturation, f"from saturation_level of the camera's .mat: {', '.join(whites)}"
            ),
            "mask": "the chart: "
            + "; ".join(
                f"of {', '.join(names)} by {text}" if len(sources) > 1 else text for text, names in sources.items()
            ),
            "ground truth": "groundtruth_illuminants of the .mat",
        },
    )


def _mat_files(folder: Folder) -> Iterator[Path]:
    for child in folder.within(1):
        # A file named only `_gt.mat` has no camera name and is ignored.
        yield from (child.path / name for name in child.files if name.endswith(_MAT_ENDING) and name != _MAT_ENDING)


def _open_camera(
    root: Folder, camera: str, path: Path, options: DataOptions
) -> tuple[list[RawScene], str, tuple[float, float], str]:
    """Return scenes, a note on their number, (black level, saturation), and the source of the chart boxes."""
    content = read_mat(path)
    lights = numeric_table(content, "groundtruth_illuminants", path, 3)
    folder, images = _find_images(root, camera, path)
    names = names_or_none(content, "all_image_names", path)
    if names is None:
        names = list(images)  # Some versions of the .mat have no names; their rows are in the order of the file names.
    if len(names) != len(lights):
        raise FormatError(
            f"{path} has {len(lights)} ground truths for {len(names)} images of {camera} in {folder}, expected equal "
            "numbers; complete the copy"
        )
    indices, note = match_images(names, images, path.name, folder, options.partial)
    boxes, source = chart_boxes(content, path, names, indices, root)
    black = scalar(content, "darkness_level", path) if options.black is None else options.black
    white = scalar(content, "saturation_level", path) if options.saturation is None else options.saturation
    if white <= black:
        raise FormatError(f"{path}: saturation {white:g}, expected above black {black:g}; correct or give the levels")
    scenes: list[RawScene] = [
        ChartScene(
            names[index],
            images[names[index]],
            check_light(lights[index].tolist(), f"{path}, row {index + 1} of groundtruth_illuminants"),
            black,
            white,
            boxes[index],
        )
        for index in indices
    ]
    return scenes, note, (black, white), source


def _find_images(root: Folder, camera: str, path: Path) -> tuple[Path, dict[str, str]]:
    mat_folder = Folder(path.parent)
    folders = [mat_folder, *(mat_folder.folders.get(name) for name in ("PNG", "png")), root.folders.get("images")]
    for image_folder in folders:
        images = {} if image_folder is None else image_folder.images()
        images = {name: file for name, file in images.items() if name.startswith(f"{camera}_")}
        if image_folder is not None and images:
            return image_folder.path, images
    raise FormatError(
        f"no image {camera}_….PNG in {path.parent}, its folder PNG or {root.path / 'images'}, expected the images of "
        f"{path.name}; unpack the archives of PNG files there"
    )
