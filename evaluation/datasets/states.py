"""Whether the images of a data set are still those that they were: what a run that goes on has to know."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import numpy as np

from evaluation.datasets.generated import GeneratedScene
from evaluation.datasets.raw_scene import RawScene
from evaluation.datasets.thumbnails import Thumbnail
from evaluation.scene import Scene
from foundation.errors import CropError
from foundation.hashing import sha256_of

_FILES = ("path", "mask_path", "shares_path")
"""Fields of a scene that name its files."""

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
