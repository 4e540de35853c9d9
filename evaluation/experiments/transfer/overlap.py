"""Images that training and test share: a method that has seen a test image, or its scene, is not tested.

Generated images are compared by their source pictures: with another generated set by the hash of the file, with real
images by the name, since a print of a photograph that is a test image shows the test image's scene. Real images are
compared by name and by their pixels. A name is compared without folder and ending, capitals and case being one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from evaluation.datasets.generated import GeneratedScene
from evaluation.scene import Scene, SceneSet
from foundation.errors import InputError, first_of
from foundation.hashing import sha256_of

Shared = Literal["refuse", "leave-out", "keep"]
"""What to do about training images that show what test images show."""


@dataclass(frozen=True)
class SharedImage:
    """A training image that shows what a test image shows.

    - `position`: its place in the training set, from 0.
    - `name`: its name there, or that of its source picture.
    - `test`: the test image's name, or that of its source picture.
    - `by`: how it was found out: by "name" or by "content".
    """

    position: int
    name: str
    test: str
    by: str


def shared_images(training: SceneSet, test: SceneSet) -> tuple[SharedImage, ...]:
    """Return the training images that test images share a picture or a scene with.

    Pixels are read where both sets are real ones.
    """
    if _place(training) == _place(test):
        raise InputError(
            f"{test.place} is both training and test; errors of a data set that is tested on itself are found by "
            "cross-validation: evaluate cv"
        )
    made = [isinstance(some.scenes[0], GeneratedScene) for some in (training, test)]
    how = _How(names=not all(made), pixels=not any(made))
    tests = {key: name for name, keys in _keys(test, how) for key in keys}
    shared: list[SharedImage] = []
    for position, (name, keys) in enumerate(_keys(training, how)):
        found = next(((tests[key], key[0]) for key in keys if key in tests), None)
        if found:
            shared.append(SharedImage(position, name, *found))
    return tuple(shared)


def trainable_images(
    training: SceneSet, test: SceneSet, shared: Shared, called: str = "the test set", *, copies: bool = True
) -> tuple[tuple[Scene, ...], str]:
    """Return the images of a set that may be trained on, and in words what it shares with the test, "" for nothing."""
    common = shared_images(training, test)
    if not common:
        return training.scenes, ""
    told = (
        f"{len(common)} of {len(training.scenes)} images of {training.name} are also in {called}, by {common[0].by}: "
        f"{first_of([one.name for one in common], 3)}"
    )
    if shared == "keep" and not copies and any(one.by == "content" for one in common):
        raise InputError(f"{told}; what is tested must be unseen: --shared leave-out trains without them")
    if shared == "refuse":
        raise InputError(
            f"{told}; --shared leave-out trains without them, --shared keep with them (what was tested is then no "
            "longer unseen)"
        )
    dropped = {one.position for one in common} if shared == "leave-out" else set[int]()
    return tuple(scene for place, scene in enumerate(training.scenes) if place not in dropped), told


_Key = tuple[str, str]
"""How an image is known, "name" or "content", and by what."""


@dataclass(frozen=True)
class _How:
    """By what images are compared besides the hashes of source pictures, which are always at hand."""

    names: bool
    pixels: bool


def _keys(scenes: SceneSet, how: _How) -> list[tuple[str, tuple[_Key, ...]]]:
    """Return the name of each image, or of its source, and the keys that it is known by."""
    sources: dict[int, dict[str, _Key]] = {}
    listed: list[tuple[str, tuple[_Key, ...]]] = []
    for scene in scenes.scenes:
        if not isinstance(scene, GeneratedScene):
            content = (("content", _pixels(scene)),) if how.pixels else ()
            listed.append((scene.name, content + _name_key(scene.name, how)))
            continue
        known = sources.setdefault(id(scene.dataset), _sources(scene))
        source = scene.entry.source
        listed.append((source, (known[source], *_name_key(source, how))))
    return listed


def _name_key(name: str, how: _How) -> tuple[_Key, ...]:
    return (("name", PurePosixPath(name).stem.lower()),) if how.names else ()


def _sources(scene: GeneratedScene) -> dict[str, _Key]:
    """Return by what the source pictures of a generated set are known: the hash of the file, or how it was drawn."""
    seed = scene.dataset.description.seed
    return {
        record.name: ("content", record.sha256 or f"{record.name} of seed {seed}") for record in scene.dataset.sources
    }


def _pixels(scene: Scene) -> str:
    image, _ = scene.read()
    return sha256_of(np.ascontiguousarray(image, dtype=np.float32))


def _place(scenes: SceneSet) -> str:
    return scenes.place.rstrip("/") if "://" in scenes.place else str(Path(scenes.place).resolve())
