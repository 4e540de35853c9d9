"""The contact sheet: a page of tone-mapped previews, one row a source picture, one column a light.

Of a dataset with one light a picture, the usual one for training, the images fill a grid instead.
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

MAX_ROWS: Final = 12  # Sources of a sheet: what is still recognised where the page fills a screen
MAX_COLUMNS: Final = 8  # Lights of a sheet, for the same reason
# Images of one light each over rows of several: 24 in a grid of 6 by 4 fill a screen as 12 rows of 8 lights do.
_ALONE: Final = 2
# Columns over rows of that grid: most pictures and screens are about as wide, and captions stand below.
_WIDE: Final = 1.5
_NAME: Final = 26  # Characters of a name below one image of the grid: more would run into its neighbour's
_PAPER: Final = "#16171a"
_INK: Final = "#e8e6e1"
_FAINT: Final = "#8d8f96"


def contact_sheet(dataset: Dataset, max_rows: int = MAX_ROWS, max_columns: int = MAX_COLUMNS) -> npt.NDArray[np.uint8]:
    """Return the contact sheet of a dataset as a picture (H, W, 3) uint8.

    Of more sources than `max_rows`, or more lights a source than `max_columns`, an even choice is shown. Where every
    source has one image, up to 2 `max_rows` of them are shown in a grid, which says of how many.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(_draw(dataset, max_rows, max_columns))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_contact_sheet(dataset: Dataset, path: Path) -> None:
    """Write the contact sheet of a dataset as a PNG file."""
    import cv2

    sheet = contact_sheet(dataset)
    write_atomic(path, cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())


def _even(count: int, most: int) -> list[int]:
    """Return at most `most` numbers of 0 … count − 1, first and last among them, evenly spread."""
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, most))})


def _load(dataset: Dataset, entry: Entry) -> npt.NDArray[np.uint8]:
    """Return the preview (H, W, 3) uint8 of an image, sRGB codes."""
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

    made = dataset.description
    # Sources that were drawn several times have one name; those that make one image each still fill a grid.
    alone = made.images == made.sources
    grid = _flow(dataset.entries, max_rows, max_columns) if alone else _rows(dataset.entries, max_rows, max_columns)
    pictures = [[_load(dataset, entry) for entry in line] for line in grid]
    lights = len(dataset.light_labels)
    table_lights = {light.illumination: light for light in dataset.description.lights}
    named = {str(number): light.label for number, light in table_lights.items()}
    shared = all([entry.lights for entry in line] == [entry.lights for entry in grid[0]] for line in grid)
    if alone:
        shared = len({entry.lights for line in grid for entry in line}) == 1

    # All in inches; a cell keeps the aspect of the widest picture and rows are as high as theirs need. In a
    # grid upright pictures stand in squares, since those beside them mostly lie.
    cell, gap, margin, caption = 1.75, 0.12, 0.4, 0.26
    most = 1.0 if alone else np.inf
    heights = [max(min(picture.shape[0] / picture.shape[1], most) for picture in line) * cell for line in pictures]
    head = 1.0 + (0.42 if shared else 0.0)
    below = gap + 0.2 if shared else gap + caption + 0.2
    columns = max(map(len, grid))
    width = 2 * margin + columns * cell + (columns - 1) * gap
    width = max(width, 5.2)
    height = head + sum(heights) + len(heights) * below + 0.55
    # Any: matplotlib's type hints leave keyword arguments open.
    figure: Any = Figure(figsize=(width, height), dpi=150, facecolor=_PAPER)

    def put(x: float, y: float, words: str, size: float, colour: str = _INK, **style: str) -> None:
        figure.text(
            x / width,
            1 - y / height,
            words,
            # A name may hold dollar signs.
            {"fontsize": size, "color": colour, "va": "baseline", "parse_math": False, **style},
        )

    def dot(x: float, y: float, light: str) -> None:
        radius = 0.055
        axes = figure.add_axes((x / width, 1 - (y + radius) / height, 2 * radius / width, 2 * radius / height))
        axes.set_xlim(-1.15, 1.15)
        axes.set_ylim(-1.15, 1.15)
        axes.axis("off")
        axes.add_patch(Circle((0, 0), 1, facecolor=_colour(light, table_lights), edgecolor=_FAINT, linewidth=0.4))

    table = dataset.description.table
    camera = table.camera if table.computed is None else f"{table.camera}, computed"
    sources = len({entry.source for entry in dataset.entries})
    things = "pictures" if sources == made.images else "images"
    count = sum(map(len, grid))
    shown = f"; {count} of {made.images} {things} shown" if alone or count < made.images else ""
    put(margin, 0.5, camera, 13, weight="bold")
    put(
        margin,
        0.74,
        f"{made.images} raw images of {sources} pictures, "
        f"{lights} light{'s' if lights > 1 else ''}, seed {made.seed}{shown}",
        8,
        _FAINT,
    )
    top = head
    for row, (line, drawn) in enumerate(zip(grid, pictures, strict=True)):
        for column, (entry, picture) in enumerate(zip(line, drawn, strict=True)):
            left = margin + column * (cell + gap)
            tall = min(picture.shape[0] / picture.shape[1], most) * cell
            wide = cell if tall < most * cell else tall * picture.shape[1] / picture.shape[0]
            axes = figure.add_axes((left / width, 1 - (top + tall) / height, wide / width, tall / height))
            axes.imshow(picture, interpolation="lanczos", aspect="auto")
            axes.axis("off")
            under_it = shared and row == 0 and (column == 0 or not alone)
            if under_it or not shared:
                y = head - 0.2 if under_it else top + heights[row] + 0.15
                for place, light in enumerate(entry.lights):
                    dot(left + 0.13 * place, y, light)
                labels = dict.fromkeys(map(partial(_label, named), entry.lights, entry.truths))
                words = _short(" and ".join(labels), 28)
                size, ink = (8, _INK) if under_it else (7, _FAINT)
                put(left + 0.05 + 0.13 * len(entry.lights), y + 0.04, words, size, ink)
        under = top + heights[row] + (0.0 if shared else caption)
        for column, entry in enumerate(line if alone else line[:1]):
            name = _short(entry.source, _NAME) if alone else _short(entry.source)
            put(margin + column * (cell + gap), under + 0.17, name, 7, _FAINT, style="italic")
        top += heights[row] + below
    put(
        margin, height - 0.25, "Tone mapped (Flash), each exposed for itself; camera RGB, no white balance", 6.5, _FAINT
    )
    return figure


def _rows(entries: Sequence[Entry], max_rows: int, max_columns: int) -> list[list[Entry]]:
    rows: dict[str, list[Entry]] = {}
    for entry in entries:
        rows.setdefault(entry.source, []).append(entry)
    names = [list(rows)[place] for place in _even(len(rows), max_rows)]
    columns = _even(max(len(rows[name]) for name in names), max_columns)
    return [[rows[name][place] for place in columns if place < len(rows[name])] for name in names]


def _flow(entries: Sequence[Entry], max_rows: int, max_columns: int) -> list[list[Entry]]:
    """Return an even choice of images of one light each, row by row in a grid somewhat wider than high."""
    chosen = [entries[place] for place in _even(len(entries), _ALONE * max_rows)]
    columns = min(max(round((_WIDE * len(chosen)) ** 0.5), 1), max_columns)
    return [chosen[first : first + columns] for first in range(0, len(chosen), columns)]


def _label(named: Mapping[str, str], light: str, truth: Triple) -> str:
    """Return what to call a light: as a person does, or for a mixture its chromaticity."""
    return named.get(light) or "r {} b {}".format(*(f"{part:.2f}".lstrip("0") for part in truth[::2]))


def _colour(light: str, lights: Mapping[int, Light]) -> Triple:
    """Return the colour that a projector would show for a light or a mixture: codes add in linear light."""
    mixture = parse_mixture(light)
    codes = np.array([lights[number].codes for number in mixture.lights]) / 255
    red, green, blue = (float(part) for part in (np.asarray(mixture.weights) @ codes**2.2) ** (1 / 2.2))
    return red, green, blue


def _short(name: str, most: int = 60) -> str:
    return name if len(name) <= most else f"…{name[-most:]}"
