"""Relight real scenes: each thumbnail divided by its light and multiplied by another (von Kries).

`python examples/relit.py OUT.npz LIGHTS.csv COUNT ARCHIVE...` writes COUNT thumbnails of the scenes of the archives
under the lights of the file (r,g,b a line), each scene and each light about equally often. A method that is trained on
real scenes of other cameras, relit to a camera's lights, and tested on that camera, says how much of what generated
images lack is lacking in any images but the camera's own: the yardstick of docs/transfer.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

SEED = 0
"""Of the order of scenes and lights."""


def main(out: str, lights: str, count: str, *archives: str) -> None:
    """Write the archive `images` (COUNT, H, W, 3) float32, `gt` (COUNT, 3), `names` (COUNT,)."""
    rng = np.random.default_rng(SEED)
    scenes, names = zip(*(load(archive) for archive in archives), strict=True)
    surfaces: npt.NDArray[np.float32] = np.concatenate(scenes)
    named = [name for some in names for name in some]
    targets: npt.NDArray[np.float64] = np.loadtxt(Path(lights), delimiter=",", skiprows=1)
    total = int(count)
    places, under = (
        np.concatenate([rng.permutation(number) for _ in range(-(-total // number))])[:total]
        for number in (len(surfaces), len(targets))
    )
    images = surfaces[places] * targets[under][:, None, None].astype(np.float32)
    images /= images.max(axis=(1, 2, 3), keepdims=True)
    unique = np.array([f"{number}_{named[place]}" for number, place in enumerate(places.tolist())])
    np.savez(out, images=images, gt=targets[under], names=unique)


def load(archive: str) -> tuple[npt.NDArray[np.float32], list[str]]:
    """Return the scenes (N, H, W, 3) float32 of an archive as under a light of 1, 1, 1, and their names."""
    with np.load(archive) as content:
        truths = content["gt"] / content["gt"].sum(axis=1, keepdims=True)
        scenes = content["images"].astype(np.float32) / truths[:, None, None].astype(np.float32)
        return scenes, [str(name) for name in content["names"].tolist()]


if __name__ == "__main__":
    main(*sys.argv[1:])
