"""The texts beside a dataset: its card and its datasheet.

`README.md` is a dataset card as the Hugging Face Hub reads it, `DATASHEET.md` answers the questions of Gebru et al.,
"Datasheets for Datasets", Communications of the ACM 64 (2021). What only the makers of a dataset know is marked as
open.
"""

from __future__ import annotations

import json
from pathlib import Path
from statistics import median
from string import Template
from typing import Any, Final

from calibration.citation import bibtex, origin_lines, table_title
from foundation.errors import counted
from generator.dataset.joined import JoinedLayout
from generator.dataset.layouts import LAYOUTS
from generator.dataset.records import DATASHEET, Description, one_line, table_cell
from generator.files import FULL, suffix_of

OPEN: Final = "**TO BE ANSWERED BY THE LAB.**"  # What stands where only the makers of a dataset know the answer


def uncertainty_of(description: Description) -> str:
    """Return in a sentence how well the lights are known."""
    known = [light.uncertainty_deg for light in description.lights if light.uncertainty_deg is not None]
    if not known:
        return "The table does not state what its lights may be off by."
    return (
        f"By the table's uncertainty budget the directions of its lights are known to {median(known):.2g}° in the "
        f"median and {max(known):.2g}° at worst (expanded uncertainty, k = 2, about 95 % of lights; `uncertainty_deg` "
        "in `dataset.json`). Differences between methods below that are none."
    )


def name_of(description: Description) -> str:
    """Return what the dataset is called until its makers name it."""
    return f"CroP images of the {one_line(description.table.camera)}, {counted(description.images, 'image')}"


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
        f"{counted(description.images, 'image')} of linear camera RGB as the raw sensor of the "
        f"{one_line(table.camera)} would "
        "give them, each with the exact colour of its light. Black is 0, saturation "
        f"{table.white_level}; nothing is white balanced. {kind_of(description)}"
    )


def brightness_note(description: Description) -> str:
    """Return why a reader that knows nothing of raw images shows them as it does, and what to do about it."""
    white = description.table.white_level
    if option(description, "format") == "dng":
        return "Images are raw files: open them with a raw developer."
    return (
        f"A reader that takes {FULL} for white, as WebDataset's decoders, imageio and image viewers do, shows them "
        f"nearly black: {white} is white here. Divide by {white} after decoding all 16 bits. Previews show "
        "what they look like."
    )


def origin_table(description: Description) -> list[tuple[str, str]]:
    """Return what the table says of its origin, names and values; what it does not say is "not recorded"."""
    return [(name, one_line(value)) for name, value in origin_lines(description.table.origin)]


def citation_of(description: Description) -> str:
    """Return a BibTeX entry of the table."""
    table = description.table
    computed = table.computed is not None
    return bibtex(table.camera, table.lights, table.software, table.sha256, table.origin, computed)


def truth_of(description: Description) -> str:
    """Return in words where the ground truth comes from."""
    if description.table.computed is not None:
        return "it is what the model of the sensor answers to bare paper under the light's spectrum."
    return "it is the mean of the white references that lie among the colours, under the same light."


def pixels_of(description: Description) -> str:
    """Return in words how a pixel comes from the table's samples, by the rendering of the dataset."""
    samples = description.table.samples
    if option(description, "rendering") is None:
        return (
            f"Each pixel is one of the {samples} samples that the table has of its colour, drawn by the seed; where "
            "lights mix, one of each."
        )
    return (
        "Each pixel is the mean of its colour, interpolated between cells of the table, plus the deviation of one of "
        f"the {samples} samples of the nearest cell from their mean, drawn by the seed and scaled to the noise at that "
        "level; where lights mix, of each."
    )


def noise_of(description: Description) -> str:
    """Return in words how many electrons a count is and what noise a sample has, as far as the table says it."""
    green = "Green is the mean of two photosites, so that its noise has half the variance of one."
    table = description.table
    if table.computed is None:
        return f"Gain and read noise are in `report.html` of the table, as measured. {green}"
    try:
        body, iso = table.computed["body"], float(table.computed["exposure"]["iso"])
        gain, read, early = (float(body[name]) for name in ("electrons_per_dn", "read_noise_dn", "sensor_noise_e"))
    except (KeyError, TypeError, ValueError):
        return f"The table does not state gain and read noise. {green}"
    return (
        f"In the model of the sensor a count is {gain * 100 / iso:.4g} electrons at its ISO {iso:g}; "
        f"at ISO 100 it is {gain:.4g}, and the read noise of a photosite {read:.4g} counts, of which {early:.4g} "
        f"electrons arise before the amplifier. {green}"
    )


def _procedure(description: Description) -> str:
    table = description.table
    name = one_line(table_title(table.camera, table.lights, table.origin, table.computed is not None))
    if table.computed is not None:
        return (
            f"{name}: samples of all colours of a chart were computed under known lights. No frame was taken, and "
            "there is no report; `computed` under `table` in `dataset.json` has the model and its settings."
        )
    return (
        f"A chart of all colours under known lights: {name}. The table's report has the verdict on it and every figure "
        "with its limit."
    )


def option(description: Description, name: str) -> Any:
    """Return an option as `dataset.json` has it; None where it was off."""
    return description.options.get(name)


def datasheet(description: Description) -> str:
    """Return the text of DATASHEET.md."""
    template = Template((Path(__file__).parent / "datasheet.md").read_text("utf-8"))
    table, origin = description.table, dict(origin_table(description))
    authors = "" if table.origin is None else "; ".join(table.origin.authors)
    splits = "; ".join(f"{part}: {images} images" for part, images in description.splits.items())
    by_colour = option(description, "rendering") is not None
    rendering = "by codes: a picture's 8-bit sRGB value is the code of a printed cell"
    answers: dict[str, object] = {
        "authors": f"The table: {authors}. The dataset: {OPEN}" if authors else OPEN,
        "camera": table.camera,
        "citation": citation_of(description),
        "dates": "No frame was taken for the table."
        if table.computed is not None
        else f"The table's frames: {origin['Dates']}.",
        "format": option(description, "format"),
        "images": counted(description.images, "image"),
        "kind": kind_of(description),
        "layout": option(description, "layout"),
        "licence": origin["Licence"],
        "lights": len(description.lights),
        "name": name_of(description),
        "noise": noise_of(description),
        "open": OPEN,
        "origin": "\n".join(f"| {name} | {table_cell(value)} |" for name, value in origin.items()),
        "pixels": description.pixels,
        "pixels_are": pixels_of(description),
        "procedure": _procedure(description),
        "rendering": "colorimetrically, interpolated between the cells of the chart" if by_colour else rendering,
        "replaced": description.replaced_pixels,
        "repeats": "Each picture is in one image."
        if description.images <= description.sources
        else "Images of one picture repeat it, or parts of it, under another light or with other noise.",
        "seed": description.seed,
        "skipped": len(description.skipped),
        "software": description.software,
        "sources": description.sources,
        "splits": f"{splits}. All images of a picture are in one part."
        if splits
        else "None; keep all images of a picture in one part.",
        "summary": summary_of(description),
        "table": table.sha256,
        "table_software": table.software,
        "truth": truth_of(description),
        "uncertainty": uncertainty_of(description),
        "white_level": table.white_level,
    }
    # The makers of the dataset are asked for whether or not those of the table are known.
    return template.substitute(answers, count=template.template.count("${open}") + 1)


# Numbers of images below which a data set is of a size category of the Hub.
_SIZES = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
    (10_000_000, "1M<n<10M"),
    (100_000_000, "10M<n<100M"),
    (1_000_000_000, "100M<n<1B"),
)

_TAGS = ("color-constancy", "white-balance", "illumination-estimation", "raw-images", "image")


def size_category(images: int) -> str:
    """Return the Hub's size category of a number of images."""
    return next((name for limit, name in _SIZES if images < limit), "1B<n<10B")


def card(description: Description) -> str:
    """Return the text of README.md; the licence is left open, for pictures have one of their own."""
    lights = "".join(f"| {light.illumination} | {light.cell} |\n" for light in description.lights[:20])
    more = f"\nand {len(description.lights) - 20} more in `dataset.json`.\n" if len(description.lights) > 20 else ""
    origin = "".join(f"| {name} | {table_cell(value)} |\n" for name, value in origin_table(description))
    splits = ", ".join(f"{part} {images}" for part, images in description.splits.items()) or "not divided"
    return (
        f"---\n{_front_matter(description)}---\n\n# {name_of(description)}\n\n{summary_of(description)}\n\n"
        f"- **Images**: {description.images}, of {description.sources} pictures; parts: {splits}\n"
        f"- **Ground truth**: `ground_truth.csv`, r + g + b = 1, a row a light; `gt.txt`, a line an image\n"
        f"- **Made by** {description.software}, seed {description.seed}; `dataset.json` has enough to make every byte "
        f"again, `SHA256SUMS` the hash of every file but this one and `{DATASHEET}`\n"
        f"- **More**: [{DATASHEET}]({DATASHEET}) (Datasheets for Datasets)\n\n"
        f"## Reading\n\n{_reading(description)}\n\n{brightness_note(description)}\n\n"
        f"## Noise\n\n{pixels_of(description)} {noise_of(description)}\n\n"
        f"## Licence\n\n**To be stated by whoever publishes**: images are made of pictures, which have licences of "
        f"their own (`sources.csv` names them), and of the table, whose licence is in the list below. Put the result "
        f"into the front matter, in place of `unknown`.\n\n"
        f"## The table\n\n{kind_of(description)} Its hash is `{description.table.sha256}`.\n\n"
        f"| | |\n|---|---|\n{origin}\n"
        f"## Lights\n\n| number | light |\n|---|---|\n{lights}{more}\n"
        f"## Citation\n\n```bibtex\n{citation_of(description)}```\n"
    )


def _front_matter(description: Description) -> str:
    keys: dict[str, object] = {
        "pretty_name": name_of(description),
        "license": "unknown",
        "tags": list(_TAGS),
        "size_categories": [size_category(description.images)],
        "annotations_creators": ["machine-generated"],
    }
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in keys.items()]
    return "".join(lines) + _configs(description)


def _configs(description: Description) -> str:
    """Return where the files of each part lie; of plain files the table of ground truths is what rows are read from."""
    layout = LAYOUTS[option(description, "layout")]
    if not layout.is_of_the_hub:
        files = "  - split: train\n    path: ground_truth.csv\n"
    else:
        files = "".join(
            f"  - split: {'train' if part == 'data' else part}\n    path: {pattern}\n"
            for part in description.parts
            for pattern in layout.patterns([part], "")
        )
    return f"configs:\n- config_name: default\n  data_files:\n{files}"


def _reading(description: Description) -> str:
    layout = LAYOUTS[option(description, "layout")]
    if isinstance(layout, JoinedLayout):
        return layout.reading
    names = layout.patterns(description.parts, suffix_of(option(description, "format")))
    files = " and ".join(f"`{name.replace('*', 'NNNNNN')}`" for name in names)
    return (
        f"{files} are linear, 16 bits where the format has them; `load_dataset` gives the rows of "
        "`ground_truth.csv`, whose column `image` names the file. Pillow, and imageio by it, keep 8 of 16 bits of a "
        "PNG: use `cv2.imread(path, cv2.IMREAD_UNCHANGED)` (then BGR) or `generator.open_dataset`."
    )
