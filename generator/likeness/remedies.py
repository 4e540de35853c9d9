"""What to do where pictures drawn are not like the real data set."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.dataset.production.options import DatasetOptions
    from generator.likeness.drawing import DrawnPictures
    from generator.statistics.statistics_file import RealStatistics


def remedies(drawn: DrawnPictures, options: DatasetOptions) -> list[str]:
    """Return which options bring figures nearer that are not alike, a line each; none where all are."""
    apart = {made.name: made for made in drawn.reached if not made.is_alike}
    if not apart:
        return []
    told: list[str] = []
    shadows, chroma = apart.get("luminance_1"), apart.get("chroma_spread")
    bright = shadows is not None and shadows.after > shadows.wanted
    pale = chroma is not None and chroma.after < chroma.wanted
    if (bright or pale) and options.rendering == "codes":
        told.append(
            "--rendering colorimetric: by codes a picture has the contrast and chroma of the print, mostly less than "
            "the scene's"
        )
    if (shadows is not None or pale) and options.black_point.kind != "like":
        told.append(
            "--black-point like: the print's own black lifts shadows and makes colours pale, and of each picture as "
            "much of it is taken out as makes it like the real ones"
        )
    told.append(
        "more pictures with --sources, or several crops of each (--crop WxH --crops N): there is more to choose from"
    )
    return [f"what may help: {line}" for line in told]


def light_caution(lut: Lut, target: RealStatistics) -> str:
    """Return that pictures were measured under one light of the table, and how figures of the images are had."""
    from generator.likeness.pictures import reference_light

    light = lut.illuminations[reference_light(lut, target.lights)]
    return (
        f"figures drawn are of pictures measured under one light, {light.index} of the table; for those of the images, "
        f"each under its own light, run evaluate describe on the dataset with --against {target.file}"
    )
