"""Files of statistics as `evaluate describe --out` writes them, made up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt


def write_stats(path: Path, lights: npt.ArrayLike, values: dict[str, npt.ArrayLike], /, **changes: Any) -> Path:
    """Write a `STATS.json` of as many images as `values` have, with `changes` of its keys, and return its path."""
    numbers = {name: np.asarray(given, dtype=float).tolist() for name, given in values.items()}
    count = max(map(len, numbers.values()), default=0)
    content: dict[str, Any] = {
        "format": "crop.statistics",
        "version": 1,
        "data": {"name": "real", "layout": "generated", "place": "somewhere", "images": count},
        "cells": 64,
        "sizes": [{"width": 60, "height": 40, "images": count}],
        "lights": np.asarray(lights, dtype=float).tolist(),
        "images": [f"image {number}" for number in range(count)],
        "values": numbers,
    }
    path.write_text(json.dumps(content | changes), encoding="utf-8")
    return path
