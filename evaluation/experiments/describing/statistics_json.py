"""`STATS.json`: a data set's description as a file, to be compared with others and to generate data like it.

The format is versioned and documented in docs/formats.md. Numbers are written with six significant digits; a figure
that is not known of an image is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from evaluation.experiments.describing.description import OF_LIGHTS, DataDescription, figures, known_values
from evaluation.experiments.describing.lights import light_distribution
from evaluation.experiments.describing.noise import NoiseCurve, NoiseLevel
from evaluation.experiments.describing.quantities import QUANTITIES
from foundation.errors import FormatError
from foundation.version import software
from generator.statistics import CHROMA_EDGES, FORMAT, LUMINANCE_EDGES, VERSION, lights_of, read_content

QUANTILES: Final = (0, 1, 5, 10, 25, 50, 75, 90, 95, 99, 100)
"""Percents at which the distribution of a number over the images is written."""

_DIGITS: Final = 6
"""Significant digits: the thousandth part of what images tell."""

_CHANNELS: Final = ("red", "green", "blue")


def statistics_to_json(description: DataDescription) -> str:
    """Return the text of a `STATS.json`; the same description gives the same text."""
    distribution = asdict(light_distribution(description.lights))
    content = {
        "format": FORMAT,
        "version": VERSION,
        "software": software(),
        "data": {
            "name": description.name,
            "layout": description.layout,
            "place": description.place,
            "images": len(description.images),
            "mixed": description.mixed,
            "groups": description.groups,
            "treatment": dict(description.treatment),
        },
        "cells": description.side,
        "sizes": [{"width": width, "height": height, "images": count} for width, height, count in description.sizes],
        "masked": description.masked,
        "figures": [
            {
                "name": quantity.name,
                "of": quantity.value,
                "summed": quantity.summed,
                "definition": quantity.definition,
                "value": figures(description)[quantity.name],
            }
            for quantity in QUANTITIES
        ],
        "quantiles": {name: _quantiles(known_values(description, name)) for name in (*description.values, *OF_LIGHTS)},
        "noise": {
            "unit": description.noise_unit,
            **{channel: asdict(curve) for channel, curve in zip(_CHANNELS, description.noise, strict=True)},
        },
        "light_distribution": distribution,
        "luminance": {"log10_edges": LUMINANCE_EDGES, "shares": description.luminance},
        "chroma": {"edges": CHROMA_EDGES, "shares": description.chroma},
        "lights": description.lights,
        "images": list(description.images),
        "values": dict(description.values),
    }
    lines = [f"{json.dumps(key)}: {json.dumps(_plain(value))}" for key, value in content.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def read_statistics(path: Path | str) -> DataDescription:
    """Return the description that a `STATS.json` holds."""
    known, _ = read_content(path)
    try:
        return _description(known)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} is not as its format has it: {error!r}; write it anew with evaluate describe DATA --out STATS.json"
        ) from error


def _description(content: Mapping[str, Any]) -> DataDescription:
    data, noise = content["data"], content["noise"]
    images = tuple(map(str, content["images"]))
    values = {name: _array(given) for name, given in content["values"].items()}
    missing = {quantity.value for quantity in QUANTITIES} - values.keys() - OF_LIGHTS.keys()
    if missing or any(given.shape != (len(images),) for given in values.values()):
        raise ValueError(f"values of {len(images)} images expected, and of {', '.join(sorted(missing)) or 'each name'}")
    luminance, chroma = _array(content["luminance"]["shares"]), _array(content["chroma"]["shares"])
    if luminance.shape != (len(LUMINANCE_EDGES) - 1,) or chroma.shape != (len(CHROMA_EDGES) - 1,) * 2:
        raise ValueError(f"histograms of {luminance.shape} and {chroma.shape} bins")
    return DataDescription(
        name=data["name"],
        layout=data["layout"],
        place=data["place"],
        treatment=dict(data["treatment"]),
        side=int(content["cells"]),
        images=images,
        mixed=int(data["mixed"]),
        sizes=tuple((int(size["width"]), int(size["height"]), int(size["images"])) for size in content["sizes"]),
        masked=float(content["masked"]),
        values=values,
        lights=lights_of(content),
        luminance=luminance,
        chroma=chroma,
        noise_unit=noise["unit"],
        noise=tuple(_curve(noise[channel]) for channel in _CHANNELS),
        groups=None if data.get("groups") is None else int(data["groups"]),
    )


def _curve(given: Mapping[str, Any]) -> NoiseCurve:
    levels = tuple(NoiseLevel(level["signal"], level["sigma"], level["blocks"]) for level in given["levels"])
    return NoiseCurve(levels, given["read"], given["gain"], given["misfit"])


def _array(given: Any) -> npt.NDArray[np.float64]:
    """Return numbers as an array, null as NaN."""
    return np.array(given, dtype=np.float64)


def _quantiles(values: npt.NDArray[np.float64]) -> dict[str, float | int | None]:
    levels = np.percentile(values, QUANTILES, method="hazen") if values.size else [None] * len(QUANTILES)
    return {"images": values.size, **{str(percent): level for percent, level in zip(QUANTILES, levels, strict=True)}}


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: rounded, and null for what is not finite."""
    match value:
        case dict():
            return {str(key): _plain(inner) for key, inner in cast("dict[Any, Any]", value).items()}
        case list() | tuple():
            return [_plain(inner) for inner in cast("list[Any]", value)]
        case np.ndarray():
            return _plain(cast("npt.NDArray[np.float64]", value).tolist())
        case float() | np.floating():
            number = float(cast("float", value))
            return float(f"{number:.{_DIGITS}g}") if math.isfinite(number) else None
        case _:
            return value
