"""Whether the images of a data set are still those that they were: what a run that goes on has to know."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Final

import numpy as np

from evaluation.datasets.generated import GeneratedScene
from evaluation.datasets.raw_scene import RawScene
from evaluation.datasets.thumbnails import Thumbnail
from evaluation.scene import Scene
from foundation.errors import CropError
from foundation.hashing import sha256_of

_FILES = ("path", "mask_path", "shares_path")
"""Fields of a scene that name its files."""

_PIECE: Final = 1 << 20
"""Bytes of a file that are compared: a hundred thousand pixels and more, of which no two photographs agree in all."""

_SUMS = "SHA256SUMS"
"""The file of a generated dataset that holds the hashes of all others."""


def state_of(scenes: Sequence[Scene]) -> str:
    """Return a text, 64 hexadecimal digits, that becomes another when the images of scenes do.

    No image is decoded. Of a file count its length and when it was written, as `make` and `rsync` do; of a dataset made
    by `generate` the hashes that it holds; of thumbnails in memory their pixels. Scenes of other kinds count as never
    changing.
    """
    state = sha256()
    known: dict[int, str] = {}
    for scene in scenes:
        for part in _parts(scene, known):
            state.update(f"{part}\n".encode())
    return state.hexdigest()


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


def _parts(scene: Scene, known: dict[int, str]) -> Iterator[str]:
    if isinstance(scene, Thumbnail):
        yield f"{scene.image.dtype} {scene.image.shape} {sha256_of(np.ascontiguousarray(scene.image))}"
    elif isinstance(scene, GeneratedScene):
        dataset = scene.dataset
        if id(dataset) not in known:
            known[id(dataset)] = ""
            # An old dataset has no such file; then its truths alone tell it from others.
            with suppress(CropError, OSError):
                known[id(dataset)] = sha256_of(dataset.store.get(_SUMS))
            yield known[id(dataset)]
    elif isinstance(scene, RawScene):
        for path in (getattr(scene, name, "") for name in _FILES):
            # A file that is missing is told when the image is read.
            with suppress(OSError):
                if path:
                    found = Path(path).stat()
                    yield f"{found.st_size} {found.st_mtime_ns}"
