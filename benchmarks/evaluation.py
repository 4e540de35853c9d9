"""How fast methods estimate: `python -m benchmarks.evaluation` prints one JSON object a line."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.generator import best, natural_picture
from evaluation.methods import standard_methods


def main() -> None:
    picture = natural_picture(2592, 1728)
    image = (picture.astype(np.float32) ** 2.2 / 16).astype(np.uint16)
    pixels = image.size / 3e6
    for name, method in standard_methods().items():
        rate = pixels / best(lambda method=method: method.estimate(image, saturation=12000.0), 2)
        figure = {"name": f"{name}, 4.5 Mpx, one thread", "value": round(rate, 2), "unit": "Mpx/s", "against": ""}
        print(json.dumps(figure), flush=True)


if __name__ == "__main__":
    main()
