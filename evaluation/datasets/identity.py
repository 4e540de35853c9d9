"""By what images are known without decoding them: whether they are copies of others.

A model file keeps of what it was trained on each image's name and light, or the picture that it was generated from, so
that a test on the same images is noticed. A name counts without folder and ending, capitals and case being one; a light
as chromaticities to four digits, since copies of a data set hold it to different ones. What was renamed, or is held to
another ground truth, is not known again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.datasets.files import RawScene
from evaluation.datasets.generated import GeneratedScene
from evaluation.datasets.thumbnails import Thumbnail
from evaluation.scene import Scene
from foundation.files import sha256_of
from generator.dataset.reader import Dataset


def identities(scenes: Sequence[Scene]) -> npt.NDArray[np.uint64]:
    """Return by what scenes are known again: (N, 2) uint64, the first 64 bits of SHA-256.

    The first is of the image: name and light; of a generated one its source picture, whatever the light. The second is
    of the name, by which a generated image and the photograph that it was made from find each other.
    """
    known: dict[int, Mapping[str, str]] = {}
    rows: list[tuple[int, int]] = []
    for scene in scenes:
        if isinstance(scene, GeneratedScene):
            source, marks = scene.entry.source, source_marks(scene.dataset, known)
            rows.append((_number("source", marks[source]), _number("generated", _stem(source))))
        else:
            total = max(float(scene.truth.sum()), np.finfo(float).tiny)
            light = " ".join(f"{part:.4f}" for part in scene.truth / total)
            rows.append((_number("image", f"{_stem(scene.name)} {light}"), _number("real", _stem(scene.name))))
    return np.array(rows, dtype=np.uint64).reshape(-1, 2)


def known_again(scenes: Sequence[Scene], trained: npt.NDArray[np.uint64]) -> tuple[str, ...]:
    """Return the names of the scenes that are among others, whose identities (N, 2) uint64 are given."""
    images = {int(one) for one in trained[:, 0]}
    names = {int(one) for one in trained[:, 1]}
    found: list[str] = []
    for scene, (own, _) in zip(scenes, identities(scenes).tolist(), strict=True):
        if isinstance(scene, GeneratedScene):
            counterpart = _number("real", _stem(scene.entry.source))
        else:
            counterpart = _number("generated", _stem(scene.name))
        if own in images or counterpart in names:
            found.append(scene.name)
    return tuple(found)


def source_marks(dataset: Dataset, known: dict[int, Mapping[str, str]]) -> Mapping[str, str]:
    """Return by what the source pictures of a generated set are known: the hash of the file, or how it was drawn.

    `known` keeps those of each set, which many images ask for.
    """
    if id(dataset) not in known:
        seed = dataset.description.seed
        known[id(dataset)] = {one.name: one.sha256 or f"{one.name} of seed {seed}" for one in dataset.sources}
    return known[id(dataset)]


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _number(kind: str, text: str) -> int:
    return int(sha256_of(f"{kind}\t{text}".encode())[:16], 16)


# Bytes of a file that are compared: a hundred thousand pixels and more, of which no two photographs agree in all.
_PIECE: Final = 1 << 20


def first_copies(scenes: Sequence[Scene]) -> list[int]:
    """Return for each of N scenes the place of the first one with the same pixels: its own where there is none before.

    A copy in another fold is an image that a method was trained on. Of files are compared the lengths, and where these
    are equal a piece from the middle, whose noise no second photograph has. Other scenes than files and thumbnails in
    memory are no copies of each other.
    """
    lengths = Counter(_length(scene) for scene in scenes)
    seen: dict[tuple[int, str], int] = {}
    found: list[int] = []
    for place, scene in enumerate(scenes):
        length = _length(scene)
        known = length is not None and lengths[length] > 1
        found.append(seen.setdefault((length or 0, _piece(scene)), place) if known else place)
    return found


def _length(scene: Scene) -> int | None:
    if isinstance(scene, Thumbnail):
        return scene.image.nbytes
    with suppress(OSError):
        if isinstance(scene, RawScene):
            return Path(scene.path).stat().st_size
    return None


def _piece(scene: Scene) -> str:
    if isinstance(scene, Thumbnail):
        return sha256_of(np.ascontiguousarray(scene.image))
    assert isinstance(scene, RawScene)
    try:
        with Path(scene.path).open("rb") as stream:
            stream.seek(max(0, (Path(scene.path).stat().st_size - _PIECE) // 2))
            return sha256_of(stream.read(_PIECE))
    except OSError:
        return scene.path  # What cannot be read is told when the image is.
