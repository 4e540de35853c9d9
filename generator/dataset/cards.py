"""The card and the datasheet of a data set.

`README.md` is a dataset card, the front page of a data set on the Hugging Face Hub. `DATASHEET.md` answers the
questions of Gebru et al., "Datasheets for Datasets", Communications of the ACM 64 (2021). Questions that only the
authors of a data set can answer are marked.
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

OPEN: Final = "**TO BE ANSWERED BY THE LAB.**"  # Marks questions that only the authors can answer


def uncertainty_of(description: Description) -> str:
    """Return sentences on the uncertainty of the ground truths."""
    uncertainties = [light.uncertainty_deg for light in description.lights if light.uncertainty_deg is not None]
    if not uncertainties:
        return "The LUT does not report the uncertainty of its ground truths."
    return (
        "The LUT reports the expanded uncertainty (k = 2, about 95 %) of its ground truths: "
        f"the median is {median(uncertainties):.2g}°, the largest {max(uncertainties):.2g}° (`uncertainty_deg` in "
        "`dataset.json`). Smaller differences between methods are not significant."
    )


def name_of(description: Description) -> str:
    """Return the default name of the data set."""
    return f"CroP images of the {one_line(description.table.camera)}, {counted(description.images, 'image')}"


def kind_of(description: Description) -> str:
    """Return a sentence on the origin of the colours: photographed, simulated or computed."""
    table = description.table
    if table.computed is not None:
        return "The LUT was computed from spectra and a model of the sensor; nothing was photographed."
    rig = None if table.origin is None else table.origin.rig
    if rig == "simulated":
        return "The LUT was made in a simulated laboratory; nothing was photographed."
    if rig is None:
        return "The LUT does not record whether its frames were photographed or simulated."
    return "The LUT was made from raw frames of a printed chart under illuminants from a projector."


def summary_of(description: Description) -> str:
    """Return sentences on the content of the images."""
    table = description.table
    return (
        f"{counted(description.images, 'image')} in linear camera RGB, as the sensor of the "
        f"{one_line(table.camera)} would record them, each with the exact colour of its illuminant. Black is 0, the "
        f"saturation level is {table.white_level}; images are not white balanced. {kind_of(description)}"
    )


def brightness_note(description: Description) -> str:
    """Return a note on the brightness of the images in programs that assume full-range images."""
    white = description.table.white_level
    if option(description, "format") == "dng":
        return "Images are raw files; open them with a raw developer."
    return (
        f"The saturation level is {white}. Programs that assume {FULL}, such as decoders of WebDataset, imageio and "
        f"image viewers, show images nearly black. Divide by {white} after decoding all 16 bits. Previews show the "
        "content."
    )


def origin_table(description: Description) -> list[tuple[str, str]]:
    """Return names and values of the origin of the LUT; missing values are "not recorded"."""
    return [(name, one_line(value)) for name, value in origin_lines(description.table.origin)]


def citation_of(description: Description) -> str:
    """Return a BibTeX entry of the LUT."""
    table = description.table
    computed = table.computed is not None
    return bibtex(table.camera, table.lights, table.software, table.sha256, table.origin, computed)


def truth_of(description: Description) -> str:
    """Return a sentence on the source of the ground truth."""
    if description.table.computed is not None:
        return "it is the response of the sensor model to bare paper under the spectrum of the illuminant."
    return "it is the mean of the white references of the chart, under the same illuminant."


def pixels_of(description: Description) -> str:
    """Return sentences on the rendering of a pixel from the samples of the LUT."""
    samples = description.table.samples
    if option(description, "rendering") is None:
        return (
            f"Each pixel is one of the {samples} samples of its colour in the LUT, drawn with the seed. For mixed "
            "illuminants, one sample for each illuminant is drawn, and these samples are mixed."
        )
    return (
        "Each pixel is the mean of its colour, interpolated between patches of the LUT, plus noise. The noise is the "
        f"deviation of one of the {samples} samples of the nearest patch from their mean, drawn with the seed and "
        "scaled to the level of the pixel. For mixed illuminants, the deviations of all illuminants are combined."
    )


def noise_of(description: Description) -> str:
    """Return sentences on gain and noise, as far as the LUT records them."""
    green = "Green is the mean of two photosites, so its noise has half the variance of one photosite."
    table = description.table
    if table.computed is None:
        return f"Measured gain and read noise are in `report.html` of the LUT. {green}"
    try:
        body, iso = table.computed["body"], float(table.computed["exposure"]["iso"])
        gain, read, early = (float(body[name]) for name in ("electrons_per_dn", "read_noise_dn", "sensor_noise_e"))
    except (KeyError, TypeError, ValueError):
        return f"The LUT does not record gain and read noise. {green}"
    return (
        f"In the model of the sensor, one count is {gain * 100 / iso:.4g} electrons at its ISO {iso:g}. "
        f"At ISO 100 one count is {gain:.4g} electrons, and the read noise of a photosite is {read:.4g} "
        f"counts. The part of it that arises before the amplifier is {early:.4g} electrons. {green}"
    )


def _procedure(description: Description) -> str:
    table = description.table
    name = one_line(table_title(table.camera, table.lights, table.origin, table.computed is not None))
    if table.computed is not None:
        return (
            f"{name}: samples of all colours of a chart were computed under known illuminants. No frame was taken, and "
            "there is no report. The model and its settings are in `dataset.json`, as `computed` of `table`."
        )
    return (
        f"A chart of all colours was photographed under known illuminants: {name}. The report of the LUT has the "
        "verdict and every figure with its limit."
    )


def option(description: Description, name: str) -> Any:
    """Return an option as in `dataset.json`; None if it was not used."""
    return description.options.get(name)


def datasheet(description: Description) -> str:
    """Return the text of DATASHEET.md."""
    template = Template((Path(__file__).parent / "datasheet.md").read_text("utf-8"))
    table, origin = description.table, dict(origin_table(description))
    authors = "" if table.origin is None else "; ".join(table.origin.authors)
    splits = "; ".join(f"{split}: {images} images" for split, images in description.splits.items())
    by_colour = option(description, "rendering") is not None
    rendering = "by codes: the 8-bit sRGB value of a picture is the code of a printed patch"
    answers: dict[str, object] = {
        "authors": f"The LUT: {authors}. The data set: {OPEN}" if authors else OPEN,
        "camera": table.camera,
        "citation": citation_of(description),
        "dates": "No frame was taken for the LUT."
        if table.computed is not None
        else f"The frames of the LUT: {origin['Dates']}.",
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
        "rendering": "colorimetrically, interpolated between the patches of the chart" if by_colour else rendering,
        "replaced": description.replaced_pixels,
        "repeats": "Each picture is used in one image."
        if description.images <= description.sources
        else "Images of one picture show it, or parts of it, under different illuminants or with different noise.",
        "seed": description.seed,
        "skipped": len(description.skipped),
        "software": description.software,
        "sources": description.sources,
        "splits": f"{splits}. All images of a picture are in one split."
        if splits
        else "None; keep all images of a picture in one split.",
        "summary": summary_of(description),
        "table": table.sha256,
        "table_software": table.software,
        "truth": truth_of(description),
        "uncertainty": uncertainty_of(description),
        "white_level": table.white_level,
    }
    # `count` is the number of questions marked with `OPEN`: those in the template, and `authors`, which is always
    # marked.
    return template.substitute(answers, count=template.template.count("${open}") + 1)


# Size categories of the Hugging Face Hub, with their upper limit in images.
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
    """Return the size category of the Hugging Face Hub."""
    return next((name for limit, name in _SIZES if images < limit), "1B<n<10B")


def card(description: Description) -> str:
    """Return the text of README.md; its licence is `unknown`, because it depends on the licences of the pictures."""
    lights = "".join(f"| {light.illumination} | {light.cell} |\n" for light in description.lights[:20])
    rest = f"\nand {len(description.lights) - 20} more in `dataset.json`.\n" if len(description.lights) > 20 else ""
    origin = "".join(f"| {name} | {table_cell(value)} |\n" for name, value in origin_table(description))
    splits = ", ".join(f"{split} {images}" for split, images in description.splits.items()) or "not divided"
    return (
        f"---\n{_front_matter(description)}---\n\n# {name_of(description)}\n\n{summary_of(description)}\n\n"
        f"- **Images**: {description.images}, of {description.sources} pictures; splits: {splits}\n"
        "- **Ground truth**: `ground_truth.csv`, r + g + b = 1, one row for each illuminant; `gt.txt`, one line for "
        f"each image\n- **Made by** {description.software}, seed {description.seed}; `dataset.json` has the settings "
        f"to reproduce every byte, `SHA256SUMS` the hash of every file except this one and `{DATASHEET}`\n"
        f"- **More**: [{DATASHEET}]({DATASHEET}) (Datasheets for Datasets)\n\n"
        f"## Reading\n\n{_reading(description)}\n\n{brightness_note(description)}\n\n"
        f"## Noise\n\n{pixels_of(description)} {noise_of(description)}\n\n"
        "## Licence\n\n**The publisher must state it**: images are made from pictures with their own licences (listed "
        "in `sources.csv`) and from the LUT, whose licence is listed below. Replace `unknown` in the front matter by "
        f"the result.\n\n"
        f"## The LUT\n\n{kind_of(description)} Its hash is `{description.table.sha256}`.\n\n"
        f"| | |\n|---|---|\n{origin}\n"
        f"## Illuminants\n\n| number | illuminant |\n|---|---|\n{lights}{rest}\n"
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
    layout = LAYOUTS[option(description, "layout")]
    # If each image has its own file, the Hub reads the rows of the table of ground truths.
    if not layout.is_read_by_hugging_face:
        files = "  - split: train\n    path: ground_truth.csv\n"
    else:
        files = "".join(
            f"  - split: {'train' if split == 'data' else split}\n    path: {pattern}\n"
            for split in description.parts
            for pattern in layout.patterns([split], "", description.table.camera)
        )
    return f"configs:\n- config_name: default\n  data_files:\n{files}"


def _reading(description: Description) -> str:
    layout = LAYOUTS[option(description, "layout")]
    if isinstance(layout, JoinedLayout):
        return layout.reading
    names = layout.patterns(description.parts, suffix_of(option(description, "format")), description.table.camera)
    files = " and ".join(f"`{name.replace('*', 'NNNNNN')}`" for name in names)
    return (
        f"{files} are linear, with 16 bits if the format supports them. `load_dataset` returns the rows of "
        "`ground_truth.csv`; the column `image` has the file name. Pillow and imageio keep only 8 of the 16 bits of a "
        "PNG; use `cv2.imread(path, cv2.IMREAD_UNCHANGED)` (in BGR order) or `generator.open_dataset`."
    )
