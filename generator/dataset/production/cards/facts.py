"""What card, datasheet and Croissant metadata say alike of a dataset: pure functions of `dataset.json`.

They hold no date and no place, so that the same command gives the same bytes.
"""

from __future__ import annotations

from typing import Any, Final

from calibration.citation import bibtex, origin_lines, table_title
from generator.dataset.production.records import Description
from generator.files import FULL

DATASHEET: Final = "DATASHEET.md"
CROISSANT: Final = "croissant.json"
CARD: Final = "README.md"

COMPLETED_BY_HAND: Final = (CARD, DATASHEET, CROISSANT)
"""Files that a lab completes, so that no hash of them is recorded; nothing of this software reads them."""


def name_of(description: Description) -> str:
    """Return what the dataset is called until its makers name it."""
    return f"CroP images of the {_one_line(description.table.camera)}, {counted_images(description)}"


def counted_images(description: Description) -> str:
    """Return the number of images in words."""
    return f"{description.images} image" + "s" * (description.images != 1)


def kind_of(description: Description) -> str:
    """Return in words whether colours were photographed, simulated or computed: no reader may take one for another."""
    table = description.table
    if table.computed is not None:
        return "The table behind them was computed from spectra and a model of the sensor; nothing was photographed."
    rig = None if table.origin is None else table.origin.rig
    if rig == "simulated":
        return "The table behind them was taken in a simulated laboratory; nothing was photographed."
    if rig is None:
        return "The table behind them does not record whether its frames were photographed or simulated."
    return "The table behind them was made from raw frames of a printed chart under a projector's lights."


def summary_of(description: Description) -> str:
    """Return what the images are, in two sentences."""
    table = description.table
    return (
        f"{counted_images(description)} of linear camera RGB as the raw sensor of the {_one_line(table.camera)} would "
        "give them, each with the exact colour of its light. Black is 0, saturation "
        f"{stored_white(description)}; nothing is white balanced. {kind_of(description)}"
    )


def stored_white(description: Description) -> int:
    """Return the number that saturation has in the files."""
    return FULL if option(description, "scale") == "full" else description.table.white_level


def brightness_note(description: Description) -> str:
    """Return why a reader that knows nothing of raw images shows them as it does, and what to do about it."""
    white = stored_white(description)
    if option(description, "format") == "dng":
        return "Images are raw files: open them with a raw developer."
    if option(description, "scale") == "full":
        counts = description.table.white_level
        return (
            f"Counts of 0 to {counts} are stretched over 16 bits: the camera's count is round(v * {counts} / {FULL}). "
            "Images are linear, so that they still look darker than photographs: for display divide by the ground "
            "truth and apply the sRGB curve."
        )
    return (
        f"A reader that takes {FULL} for white, as WebDataset's decoders, imageio and image viewers do, shows them "
        f"nearly black: {white} is white here. Divide by {white} after decoding all 16 bits, or make the dataset with "
        "generate --scale full. Previews show what they look like."
    )


def origin_table(description: Description) -> list[tuple[str, str]]:
    """Return what the table says of its origin, names and values; what it does not say is "not recorded"."""
    return [(name, _one_line(value)) for name, value in origin_lines(description.table.origin)]


def citation_of(description: Description) -> str:
    """Return a BibTeX entry of the table."""
    table = description.table
    computed = table.computed is not None
    return bibtex(table.camera, table.lights, table.software, table.sha256, table.origin, computed)


def table_name(description: Description) -> str:
    """Return what the table is called."""
    table = description.table
    return _one_line(table_title(table.camera, table.lights, table.origin, table.computed is not None))


def truth_of(description: Description) -> str:
    """Return in words where the ground truth comes from."""
    if description.table.computed is not None:
        return "it is what the model of the sensor answers to bare paper under the light's spectrum."
    return "it is the mean of the white references that lie among the colours, under the same light."


def option(description: Description, name: str) -> Any:
    """Return an option as `dataset.json` has it; None where it was off."""
    return description.options.get(name)


def table_cell(text: str) -> str:
    """Return a text that stays in its cell of a table in Markdown and is no markup of HTML."""
    return _one_line(text).replace("|", "\\|").replace("<", "&lt;")


def _one_line(text: str) -> str:
    """Return a text that no other line of a file follows from: foreign tables name cameras as they like."""
    return " ".join(text.split())
