"""The contact sheet: a page of previews with one row for each source picture and one column for each illuminant.

If each picture has one image, as usual for training, the images fill a grid instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.files import write_atomic
from generator.dataset.reader import Dataset
from generator.dataset.records import Entry, Light, Triple
from generator.files import preview_of
from generator.lights.lighting import parse_mixture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_ROWS: Final = 12  # Largest number of sources on a sheet; more images would be too small on a full screen
MAX_COLUMNS: Final = 8  # Largest number of illuminants on a sheet, for the same reason
# Largest number of images in the grid, as a multiple of `max_rows`; with 12 rows, 24 images fill a screen.
_GRID_IMAGES: Final = 2
# Ratio of columns to rows of the grid, about that of screens and of most pictures.
_GRID_ASPECT: Final = 1.5
_NAME_LENGTH: Final = 26  # Largest number of characters of a name below an image; more would overlap the next name
_PAPER: Final = "#16171a"
_INK: Final = "#e8e6e1"
_FAINT: Final = "#8d8f96"


def contact_sheet(dataset: Dataset, max_rows: int = MAX_ROWS, max_columns: int = MAX_COLUMNS) -> npt.NDArray[np.uint8]:
    """Return the contact sheet of a data set as an RGB image (H, W, 3) uint8.

    If there are more than `max_rows` sources or `max_columns` illuminants of a source, evenly spaced ones are shown. If
    each source has one image, up to 2 `max_rows` images are shown in a grid, with the total number.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(_draw(dataset, max_rows, max_columns))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_contact_sheet(dataset: Dataset, path: Path) -> None:
    """Write the contact sheet of a data set as a PNG file."""
    import cv2

    sheet = contact_sheet(dataset)
    write_atomic(path, cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())


def _even_choice(count: int, limit: int) -> list[int]:
    # At most `limit` evenly spaced numbers of 0 … count − 1, with the first and the last.
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, limit))})


def _load(dataset: Dataset, entry: Entry) -> npt.NDArray[np.uint8]:
    import cv2

    preview = dataset.read_preview(entry)
    if preview is not None:
        picture = cv2.imdecode(np.frombuffer(preview, np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is not None:
            return np.asarray(picture, dtype=np.uint8)
    return preview_of(dataset.read_image(entry), dataset.description.table.white_level)


def _draw(dataset: Dataset, max_rows: int, max_columns: int) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    record = dataset.description
    # Sources are counted, not names, because a picture that is used several times has one name.
    is_grid = record.images == record.sources
    grid = _grid(dataset.entries, max_rows, max_columns) if is_grid else _rows(dataset.entries, max_rows, max_columns)
    pictures = [[_load(dataset, entry) for entry in line] for line in grid]
    lights = len(dataset.light_labels)
    table_lights = {light.illumination: light for light in dataset.description.lights}
    light_names = {str(number): light.label for number, light in table_lights.items()}
    has_common_lights = all([entry.lights for entry in line] == [entry.lights for entry in grid[0]] for line in grid)
    if is_grid:
        has_common_lights = len({entry.lights for line in grid for entry in line}) == 1

    # Sizes in inches. A cell is the place of one image; a row is as high as its highest image. In a grid, images in
    # portrait format are reduced to squares, because their neighbours are mostly in landscape format.
    cell, gap, margin, caption = 1.75, 0.12, 0.4, 0.26
    max_aspect = 1.0 if is_grid else np.inf
    heights = [
        max(min(picture.shape[0] / picture.shape[1], max_aspect) for picture in line) * cell for line in pictures
    ]
    header = 1.0 + (0.42 if has_common_lights else 0.0)
    gap_below = gap + 0.2 if has_common_lights else gap + caption + 0.2
    columns = max(map(len, grid))
    width = 2 * margin + columns * cell + (columns - 1) * gap
    width = max(width, 5.2)
    height = header + sum(heights) + len(heights) * gap_below + 0.55
    # Any, because the type hints of matplotlib do not cover the keyword arguments.
    figure: Any = Figure(figsize=(width, height), dpi=150, facecolor=_PAPER)

    def write(x: float, y: float, label: str, size: float, colour: str = _INK, **style: str) -> None:
        figure.text(
            x / width,
            1 - y / height,
            label,
            # A name may contain dollar signs.
            {"fontsize": size, "color": colour, "va": "baseline", "parse_math": False, **style},
        )

    def draw(x: float, y: float, light: str) -> None:
        radius = 0.055
        axes = figure.add_axes((x / width, 1 - (y + radius) / height, 2 * radius / width, 2 * radius / height))
        axes.set_xlim(-1.15, 1.15)
        axes.set_ylim(-1.15, 1.15)
        axes.axis("off")
        axes.add_patch(Circle((0, 0), 1, facecolor=_colour(light, table_lights), edgecolor=_FAINT, linewidth=0.4))

    table = dataset.description.table
    camera = table.camera if table.computed is None else f"{table.camera}, computed"
    sources = len({entry.source for entry in dataset.entries})
    noun = "pictures" if sources == record.images else "images"
    count = sum(map(len, grid))
    shown_note = f"; {count} of {record.images} {noun} shown" if is_grid or count < record.images else ""
    write(margin, 0.5, camera, 13, weight="bold")
    write(
        margin,
        0.74,
        f"{record.images} raw images of {sources} pictures, "
        f"{lights} illuminant{'s' if lights > 1 else ''}, seed {record.seed}{shown_note}",
        8,
        _FAINT,
    )
    top = header
    for row, (line, previews) in enumerate(zip(grid, pictures, strict=True)):
        for column, (entry, picture) in enumerate(zip(line, previews, strict=True)):
            x0 = margin + column * (cell + gap)
            height_in = min(picture.shape[0] / picture.shape[1], max_aspect) * cell
            width_in = cell if height_in < max_aspect * cell else height_in * picture.shape[1] / picture.shape[0]
            axes = figure.add_axes((x0 / width, 1 - (top + height_in) / height, width_in / width, height_in / height))
            axes.imshow(picture, interpolation="lanczos", aspect="auto")
            axes.axis("off")
            is_header = has_common_lights and row == 0 and (column == 0 or not is_grid)
            if is_header or not has_common_lights:
                y = header - 0.2 if is_header else top + heights[row] + 0.15
                for dot_index, light in enumerate(entry.lights):
                    draw(x0 + 0.13 * dot_index, y, light)
                labels = dict.fromkeys(map(partial(_label, light_names), entry.lights, entry.truths))
                label = _shortened(" and ".join(labels), 28)
                size, ink = (8, _INK) if is_header else (7, _FAINT)
                write(x0 + 0.05 + 0.13 * len(entry.lights), y + 0.04, label, size, ink)
        name_y = top + heights[row] + (0.0 if has_common_lights else caption)
        for column, entry in enumerate(line if is_grid else line[:1]):
            name = _shortened(entry.source, _NAME_LENGTH) if is_grid else _shortened(entry.source)
            write(margin + column * (cell + gap), name_y + 0.17, name, 7, _FAINT, style="italic")
        top += heights[row] + gap_below
    write(margin, height - 0.25, "Tone mapped (Flash) image by image; camera RGB, no white balance", 6.5, _FAINT)
    return figure


def _rows(entries: Sequence[Entry], max_rows: int, max_columns: int) -> list[list[Entry]]:
    rows: dict[str, list[Entry]] = {}
    for entry in entries:
        rows.setdefault(entry.source, []).append(entry)
    names = [list(rows)[index] for index in _even_choice(len(rows), max_rows)]
    columns = _even_choice(max(len(rows[name]) for name in names), max_columns)
    return [[rows[name][index] for index in columns if index < len(rows[name])] for name in names]


def _grid(entries: Sequence[Entry], max_rows: int, max_columns: int) -> list[list[Entry]]:
    selected = [entries[index] for index in _even_choice(len(entries), _GRID_IMAGES * max_rows)]
    columns = min(max(round((_GRID_ASPECT * len(selected)) ** 0.5), 1), max_columns)
    return [selected[first : first + columns] for first in range(0, len(selected), columns)]


def _label(light_names: Mapping[str, str], light: str, truth: Triple) -> str:
    # A mixture has no label in the LUT, so its chromaticity is shown.
    return light_names.get(light) or "r {:.2f} b {:.2f}".format(*truth[::2])


def _colour(light: str, lights: Mapping[int, Light]) -> Triple:
    # Approximate colour for a display, from the codes of the projector; codes of a mixture are added in linear light.
    mixture = parse_mixture(light)
    codes = np.array([lights[number].codes for number in mixture.lights]) / 255
    red, green, blue = (float(channel) for channel in (np.asarray(mixture.weights) @ codes**2.2) ** (1 / 2.2))
    return red, green, blue


def _shortened(name: str, limit: int = 60) -> str:
    return name if len(name) <= limit else f"…{name[-limit:]}"
