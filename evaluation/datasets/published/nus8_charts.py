"""Where the chart lies in an image of NUS 8 cameras: CC_coords of the camera's .mat, or the text files of its masks.

    CAMERA/CHECKER/CAMERA_0001_mask.txt     x,y,width,height of the chart; then two lines a patch: x, y of its corners

The folder is what the archives MASK of the data set unpack to; it may also lie in that of all cameras. What the lines
mean is told in github.com/mahmoudnafifi/WB_sRGB, issue 15, whose author worked in the data set's laboratory: the first
is a rectangle for MATLAB's `imcrop`, so px counted from 1, whose last row and column are round(y + height) and
round(x + width). Not verified against a real copy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.datasets.names import Folder
from evaluation.datasets.published.matlab import table
from evaluation.datasets.truths import numbers_in, read_text
from foundation.errors import FormatError, first_of

Box = tuple[int, int, int, int]
"""First and last row, first and last column of a chart, px counted from 1, both ends included."""

_COORDS = "CC_coords"
_MASKS = "CHECKER"
_ALIKE = 0.5
"""Share of their union that two boxes of one chart have in common at least.

Margins around a chart may differ from source to source; boxes counted from another corner, of a turned image or with
rows and columns in each other's place meet less.
"""


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
                f"({first_of(missing)}), expected the chart of every image in one of them; fetch GROUNDTRUTH or MASK "
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
                f"{mask} has the chart of {names[number]} in {_told(other)}, but {_COORDS} of {path}, row "
                f"{number + 1}, in {_told(boxes[number])}, expected the same chart in both; restore the one that is "
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


def _told(box: Box) -> str:
    return f"rows {box[0]} to {box[1]} and columns {box[2]} to {box[3]}"


def _mask_files(path: Path, root: Folder) -> dict[str, Path]:
    """Return the text files of masks by the names of their images: beside the .mat, else in the folder of all."""
    for place in (Folder(path.parent), root):
        for name, below in place.folders.items():
            if name.upper() == _MASKS:
                ending = "_mask.txt"
                return {file[: -len(ending)]: below.path / file for file in below.files if file.endswith(ending)}
    return {}
