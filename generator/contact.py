"""The contact sheet: a page of tone-mapped previews, one row a source picture, one column a light."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.storage import write_whole
from generator.dataset import Dataset, Entry, preview_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_ROWS = 12
MAX_COLUMNS = 8
_PAPER = "#16171a"
_INK = "#e8e6e1"
_FAINT = "#8d8f96"


def contact_sheet(dataset: Dataset, max_rows: int = MAX_ROWS, max_columns: int = MAX_COLUMNS) -> npt.NDArray[np.uint8]:
    """Return the contact sheet of a dataset as a picture (H, W, 3) uint8.

    Of more sources than `max_rows`, or more lights a source than `max_columns`, an even choice is shown.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(_draw(dataset, max_rows, max_columns))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_contact_sheet(dataset: Dataset, path: Path, max_rows: int = MAX_ROWS, max_columns: int = MAX_COLUMNS) -> None:
    """Write the contact sheet of a dataset as a PNG file."""
    import cv2

    sheet = contact_sheet(dataset, max_rows, max_columns)
    write_whole(path, cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())


def _even(count: int, most: int) -> list[int]:
    """Return at most `most` numbers of 0 … count − 1, first and last among them, evenly spread."""
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, most))})


def _load(dataset: Dataset, entry: Entry) -> npt.NDArray[np.uint8]:
    import cv2

    path = dataset.preview_path(entry)
    if path.is_file():
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is not None:
            return np.asarray(picture, dtype=np.uint8)
    return preview_of(dataset.read_image(entry), dataset.description.table.white_level)


def _draw(dataset: Dataset, max_rows: int, max_columns: int) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    rows: dict[str, list[Entry]] = {}
    for entry in dataset.entries:
        rows.setdefault(entry.source, []).append(entry)
    names = [list(rows)[place] for place in _even(len(rows), max_rows)]
    columns = _even(max(len(rows[name]) for name in names), max_columns)
    grid = [[rows[name][place] for place in columns if place < len(rows[name])] for name in names]
    pictures = [[_load(dataset, entry) for entry in line] for line in grid]
    lights = {light.illumination: light for light in dataset.description.lights}
    shared = all([entry.illumination for entry in line] == [entry.illumination for entry in grid[0]] for line in grid)

    # All in inches; a cell keeps the aspect of the widest picture and rows are as high as theirs need.
    cell, gap, margin, caption = 1.75, 0.12, 0.4, 0.26
    heights = [max(picture.shape[0] / picture.shape[1] for picture in line) * cell for line in pictures]
    head = 1.0 + (0.42 if shared else 0.0)
    below = gap + 0.2 if shared else gap + caption + 0.2
    width = 2 * margin + len(columns) * cell + (len(columns) - 1) * gap
    width = max(width, 5.2)
    height = head + sum(heights) + len(heights) * below + 0.55
    # Any: matplotlib's type hints leave keyword arguments open.
    figure: Any = Figure(figsize=(width, height), dpi=150, facecolor=_PAPER)

    def put(x: float, y: float, words: str, size: float, colour: str = _INK, **style: str) -> None:
        figure.text(x / width, 1 - y / height, words, {"fontsize": size, "color": colour, "va": "baseline", **style})

    def dot(x: float, y: float, codes: tuple[int, int, int]) -> None:
        radius = 0.055
        axes = figure.add_axes((x / width, 1 - (y + radius) / height, 2 * radius / width, 2 * radius / height))
        axes.set_xlim(-1.15, 1.15)
        axes.set_ylim(-1.15, 1.15)
        axes.axis("off")
        axes.add_patch(Circle((0, 0), 1, facecolor=[code / 255 for code in codes], edgecolor=_FAINT, linewidth=0.4))

    table = dataset.description.table
    put(margin, 0.5, table.camera, 13, weight="bold")
    put(
        margin,
        0.74,
        f"{dataset.description.images} raw images of {len(rows)} pictures, "
        f"{len(lights)} light{'s' if len(lights) > 1 else ''}, seed {dataset.description.seed}",
        8,
        _FAINT,
    )
    top = head
    for row, (name, line, drawn) in enumerate(zip(names, grid, pictures, strict=True)):
        for column, (entry, picture) in enumerate(zip(line, drawn, strict=True)):
            left = margin + column * (cell + gap)
            tall = picture.shape[0] / picture.shape[1] * cell
            axes = figure.add_axes((left / width, 1 - (top + tall) / height, cell / width, tall / height))
            axes.imshow(picture, interpolation="lanczos", aspect="auto")
            axes.axis("off")
            light = lights[entry.illumination]
            if shared and row == 0:
                dot(left, head - 0.2, light.codes)
                put(left + 0.18, head - 0.16, light.label, 8)
            elif not shared:
                dot(left, top + heights[row] + 0.15, light.codes)
                put(left + 0.18, top + heights[row] + 0.19, light.label, 7, _FAINT)
        under = top + heights[row] + (0.0 if shared else caption)
        put(margin, under + 0.17, _short(name), 7, _FAINT, style="italic")
        top += heights[row] + below
    put(margin, height - 0.25, "Tone mapped with the Flash operator; camera RGB, no white balance", 6.5, _FAINT)
    return figure


def _short(name: str, most: int = 60) -> str:
    return name if len(name) <= most else f"…{name[-most:]}"
