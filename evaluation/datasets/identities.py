"""By what an image is known again, without its pixels: its name and light, or the picture that it was generated from.

A model file keeps these of what it was trained on, so that a test on the same images is noticed. A name counts without
folder and ending, capitals and case being one; a light as chromaticities to four digits, since copies of a data set
hold it to different ones. What was renamed, or is held to another ground truth, is not known again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
import numpy.typing as npt

from evaluation.datasets.generated import GeneratedScene
from evaluation.scene import Scene
from foundation.hashing import sha256_of


def identities(scenes: Sequence[Scene]) -> npt.NDArray[np.uint64]:
    """Return by what scenes are known again: (N, 2) uint64, the first 64 bits of SHA-256.

    The first is of the image: name and light; of a generated one its source picture, whatever the light. The second is
    of the name, by which a generated image and the photograph that it was made from find each other.
    """
    sources: dict[int, dict[str, str]] = {}
    rows: list[tuple[int, int]] = []
    for scene in scenes:
        if isinstance(scene, GeneratedScene):
            known = sources.setdefault(id(scene.dataset), _sources(scene))
            source = scene.entry.source
            rows.append((_number("source", known[source]), _number("generated", _stem(source))))
        else:
            total = max(float(scene.truth.sum()), np.finfo(float).tiny)
            light = " ".join(f"{part:.4f}" for part in scene.truth / total)
            rows.append((_number("image", f"{_stem(scene.name)} {light}"), _number("real", _stem(scene.name))))
    return np.array(rows, dtype=np.uint64).reshape(-1, 2)


def known_again(scenes: Sequence[Scene], trained: npt.NDArray[np.uint64]) -> tuple[str, ...]:
    """Return the names of the scenes that are among others, whose identities (N, 2) uint64 are given."""
    images = {int(one) for one in trained[:, 0]}
    names = {int(one) for one in trained[:, 1]}
    return tuple(
        scene.name
        for scene, (own, _) in zip(scenes, identities(scenes).tolist(), strict=True)
        if own in images or _counterpart(scene) in names
    )


def _counterpart(scene: Scene) -> int:
    """Return the second identity that a photograph's generated image has, or a generated image's photograph."""
    if isinstance(scene, GeneratedScene):
        return _number("real", _stem(scene.entry.source))
    return _number("generated", _stem(scene.name))


def _sources(scene: GeneratedScene) -> dict[str, str]:
    seed = scene.dataset.description.seed
    return {record.name: record.sha256 or f"{record.name} of seed {seed}" for record in scene.dataset.sources}


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _number(kind: str, text: str) -> int:
    return int(sha256_of(f"{kind}\t{text}".encode())[:16], 16)
