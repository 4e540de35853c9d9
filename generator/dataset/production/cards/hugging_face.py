"""README.md as the Hugging Face Hub reads it: YAML front matter for programs, then a card for people.

Source: huggingface.co/docs/hub/datasets-cards and huggingface/hub-docs, `datasetcard.md` (keys and values of the front
matter), huggingface.co/docs/hub/datasets-manual-configuration (`configs`). Values are written as JSON, which is
YAML 1.2 (YAML specification 1.2.2, section 1.1).
"""

from __future__ import annotations

import json

from generator.dataset.production.cards.facts import (
    CROISSANT,
    DATASHEET,
    brightness_note,
    citation_of,
    kind_of,
    name_of,
    option,
    origin_table,
    summary_of,
    table_cell,
)
from generator.dataset.production.records import Description, Light

_SIZES = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
    (10_000_000, "1M<n<10M"),
    (100_000_000, "10M<n<100M"),
    (1_000_000_000, "100M<n<1B"),
)
"""Numbers of images below which a data set is of a size category of the Hub."""

_TAGS = ("color-constancy", "white-balance", "illumination-estimation", "raw-images", "image")


def size_category(images: int) -> str:
    """Return the Hub's size category of a number of images."""
    return next((name for limit, name in _SIZES if images < limit), "1B<n<10B")


def card(description: Description) -> str:
    """Return the text of README.md; the licence is left open, for pictures have one of their own."""
    lights = "".join(f"| {light.illumination} | {_light(light)} |\n" for light in description.lights[:20])
    more = f"\nand {len(description.lights) - 20} more in `dataset.json`.\n" if len(description.lights) > 20 else ""
    origin = "".join(f"| {name} | {table_cell(value)} |\n" for name, value in origin_table(description))
    splits = ", ".join(f"{part} {images}" for part, images in description.splits.items()) or "not divided"
    return (
        f"---\n{_front_matter(description)}---\n\n# {name_of(description)}\n\n{summary_of(description)}\n\n"
        f"- **Images**: {description.images}, of {description.sources} pictures; parts: {splits}\n"
        f"- **Ground truth**: `ground_truth.csv`, r + g + b = 1, a row a light; `gt.txt`, a line an image\n"
        f"- **Made by** {description.software}, seed {description.seed}; `dataset.json` has enough to make every byte "
        f"again, `SHA256SUMS` the hash of every file but this one, `{DATASHEET}` and `{CROISSANT}`\n"
        f"- **More**: [{DATASHEET}]({DATASHEET}) (Datasheets for Datasets), [{CROISSANT}]({CROISSANT}) (MLCommons)\n\n"
        f"## Reading\n\n{_reading(description)}\n\n{brightness_note(description)}\n\n"
        f"## Licence\n\n**To be stated by whoever publishes**: images are made of pictures, which have licences of "
        f"their own (`sources.csv` names them), and of the table, whose licence is in the list below. Put the result "
        f"into the front matter, in place of `unknown`.\n\n"
        f"## The table\n\n{kind_of(description)} Its hash is `{description.table.sha256}`.\n\n"
        f"| | |\n|---|---|\n{origin}\n"
        f"## Lights\n\n| number | light |\n|---|---|\n{lights}{more}\n"
        f"## Citation\n\n```bibtex\n{citation_of(description)}```\n"
    )


def _front_matter(description: Description) -> str:
    """Return the YAML between the lines of three hyphens."""
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
    layout = option(description, "layout")
    if layout == "folder":
        files = "  - split: train\n    path: ground_truth.csv\n"
    else:
        ending = {"webdataset": "tar", "parquet": "parquet"}[str(layout)]
        parts = [part for part, images in description.splits.items() if images] or ["data"]
        files = "".join(
            f"  - split: {'train' if part == 'data' else part}\n    path: {part}/*.{ending}\n" for part in parts
        )
    return f"configs:\n- config_name: default\n  data_files:\n{files}"


def _reading(description: Description) -> str:
    """Return how the images are read without losing bits."""
    form = option(description, "format")
    if option(description, "layout") == "folder":
        return (
            f"`images/NNNNNN.{form}` are linear, 16 bits where the format has them; `load_dataset` gives the rows of "
            "`ground_truth.csv`, whose column `image` names the file. Pillow keeps 8 of 16 bits of a PNG: use "
            "`cv2.imread(path, cv2.IMREAD_UNCHANGED)` (then BGR) or `generator.open_dataset`."
        )
    return (
        "`load_dataset` finds the parts. Its decoder, Pillow, keeps 8 of 16 bits: decode the bytes with "
        "`cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)` (then BGR), with "
        '`.cast_column("png", Image(decode=False))` before it in WebDataset shards; or read with '
        "`generator.open_dataset`."
    )


def _light(light: Light) -> str:
    return table_cell(light.label if light.name or light.cct_k is not None else f"codes {light.label}")
