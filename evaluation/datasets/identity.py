"""Recognise copies of images without decoding them.

A model file stores hashes of its training images, so that a test on the same images is noticed. The hash of a
photograph is calculated from its name and ground truth, the hash of a generated image from its source picture. Renamed
photographs, and photographs with another ground truth, are not recognised.
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
    """Return two hashes of each scene, (N, 2) uint64, each the first 64 bits of a SHA-256.

    The first hash identifies the image, see the module docstring. The second is calculated from the name only. With it,
    `find_training_images` links a generated image with the photograph from which it was made.
    """
    cache: dict[int, Mapping[str, str]] = {}
    rows: list[tuple[int, int]] = []
    for scene in scenes:
        if isinstance(scene, GeneratedScene):
            source, digests = scene.entry.source, source_digests(scene.dataset, cache)
            rows.append((_hash("source", digests[source]), _hash("generated", _stem(source))))
        else:
            total = max(float(scene.truth.sum()), np.finfo(float).tiny)
            # Four digits, because copies of a data set have ground truths of different precision.
            light = " ".join(f"{value:.4f}" for value in scene.truth / total)
            rows.append((_hash("image", f"{_stem(scene.name)} {light}"), _hash("real", _stem(scene.name))))
    return np.array(rows, dtype=np.uint64).reshape(-1, 2)


def find_training_images(scenes: Sequence[Scene], training_identities: npt.NDArray[np.uint64]) -> tuple[str, ...]:
    """Return the names of the scenes that are among the training images with these identities, (N, 2) uint64."""
    images = {int(number) for number in training_identities[:, 0]}
    names = {int(number) for number in training_identities[:, 1]}
    recognised_names: list[str] = []
    for scene, (image_number, _) in zip(scenes, identities(scenes).tolist(), strict=True):
        if isinstance(scene, GeneratedScene):
            counterpart_hash = _hash("real", _stem(scene.entry.source))
        else:
            counterpart_hash = _hash("generated", _stem(scene.name))
        if image_number in images or counterpart_hash in names:
            recognised_names.append(scene.name)
    return tuple(recognised_names)


def source_digests(dataset: Dataset, cache: dict[int, Mapping[str, str]]) -> Mapping[str, str]:
    """Return the SHA-256 of each source picture by name; for a random picture, return its name and seed instead.

    `cache`: results of earlier calls by the `id` of the data set; new results are added.
    """
    if id(dataset) not in cache:
        seed = dataset.description.seed
        cache[id(dataset)] = {item.name: item.sha256 or f"{item.name} of seed {seed}" for item in dataset.sources}
    return cache[id(dataset)]


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _hash(role: str, text: str) -> int:
    return int(sha256_of(f"{role}\t{text}".encode())[:16], 16)


# Number of bytes of a file that are compared. They contain 100 000 pixels or more, whose noise differs between any two
# photographs.
_COMPARED_BYTES: Final = 1 << 20


def first_copies(scenes: Sequence[Scene]) -> list[int]:
    """Return for each scene the index of the first scene with the same pixels; a unique scene gets its own index.

    Files of equal length are compared by a section from their middle. Scenes that are neither files nor thumbnails in
    memory count as unique.
    """
    # Copies must be in the same fold, so that a method is not tested on a copy of a training image.
    counts = Counter(_byte_count(scene) for scene in scenes)
    first_indices: dict[tuple[int, str], int] = {}
    originals: list[int] = []
    for index, scene in enumerate(scenes):
        byte_count = _byte_count(scene)
        has_twin = byte_count is not None and counts[byte_count] > 1
        key = (byte_count or 0, _content_hash(scene) if has_twin else str(index))
        originals.append(first_indices.setdefault(key, index))
    return originals


def _byte_count(scene: Scene) -> int | None:
    if isinstance(scene, Thumbnail):
        return scene.image.nbytes
    with suppress(OSError):
        if isinstance(scene, RawScene):
            return Path(scene.path).stat().st_size
    return None


def _content_hash(scene: Scene) -> str:
    if isinstance(scene, Thumbnail):
        return sha256_of(np.ascontiguousarray(scene.image))
    assert isinstance(scene, RawScene)
    try:
        with Path(scene.path).open("rb") as stream:
            stream.seek(max(0, (Path(scene.path).stat().st_size - _COMPARED_BYTES) // 2))
            return sha256_of(stream.read(_COMPARED_BYTES))
    except OSError:
        return scene.path  # An unreadable image is reported when it is used.
