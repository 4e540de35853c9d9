"""What a transfer is to be: data sets opened, compared and cut to what may be trained on, before the work begins.

A method that has seen a test image, or its scene, is not tested. Generated images are compared by their source
pictures: with another generated set by the hash of the file, with real images by the name, since a print of a
photograph that is a test image shows the test image's scene. Real images are compared by name and by their pixels. A
name is compared without folder and ending, capitals and case being one.

The naive baseline is, for each image of a generated data set, a scene of the same picture under the same light, as
bright and as finely quantised, without a print, a camera or noise: codes become linear light by the sRGB curve, colours
those of the camera by its matrix if one is given, and each channel is multiplied by the light. What a learned method
gains by training on the generated image instead is what the table is worth. Several lights share the pixels of the
counterpart by the masks of the generated image. What `generate --exposure` and `--iso` did to the generated image is
not done to its counterpart, and a set under a gradient has none. Pictures are found again by name and hash.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.datasets.generated import GeneratedScene
from evaluation.datasets.identity import source_marks
from evaluation.experiments.transfer.rows import TrainingSet
from evaluation.scene import Scene, SceneSet
from foundation.colorimetry import decode_srgb
from foundation.errors import FormatError, InputError, first_of
from foundation.files import file_sha256, sha256_of
from generator.dataset.reader import Dataset
from generator.dataset.same_lights import preparation_of
from generator.lights.lighting import parse_mixture
from generator.pictures.random_scenes import RandomScene
from generator.pictures.sources import Preparation, find_pictures, open_picture
from generator.rendering.matrices import ColourMatrix, camera_matrix


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
            f"{test.location} is both training and test; errors of a data set that is tested on itself are found by "
            "cross-validation: evaluate cv"
        )
    made = [isinstance(some.scenes[0], GeneratedScene) for some in (training, test)]
    # Hashes of source pictures are always at hand; names and pixels are asked where one has none.
    named, seen = not all(made), not any(made)
    tests = {key: name for name, keys in _keys(test, named, seen) for key in keys}
    shared: list[SharedImage] = []
    for position, (name, keys) in enumerate(_keys(training, named, seen)):
        found = next(((tests[key], key[0]) for key in keys if key in tests), None)
        if found:
            shared.append(SharedImage(position, name, *found))
    return tuple(shared)


def trainable_images(
    training: SceneSet, test: SceneSet, leave_out: bool = True, called: str = "the test set"
) -> tuple[tuple[Scene, ...], str]:
    """Return the images of a set that may be trained on, and in words what it shares with the test, "" for nothing.

    `leave_out`: whether images that show a picture of the test are left out. If not, copies of test images are refused.
    """
    common = shared_images(training, test)
    if not common:
        return training.scenes, ""
    shared = (
        f"{len(common)} of {len(training.scenes)} images of {training.name} are also in {called}, by {common[0].by}: "
        f"{first_of([one.name for one in common], 3)}"
    )
    if leave_out:
        dropped = {one.position for one in common}
        return tuple(scene for place, scene in enumerate(training.scenes) if place not in dropped), shared
    if any(one.by == "content" for one in common):
        raise InputError(f"{shared}; what is tested must be unseen: --unseen trains without them")
    return training.scenes, shared


_Key = tuple[str, str]  # How an image is known, "name" or "content", and by what


def _keys(scenes: SceneSet, named: bool, seen: bool) -> list[tuple[str, list[_Key]]]:
    """Return the name of each image, or of its source, and the keys that it is known by."""
    known: dict[int, Mapping[str, str]] = {}
    listed: list[tuple[str, list[_Key]]] = []
    for scene in scenes.scenes:
        if isinstance(scene, GeneratedScene):
            name = scene.entry.source
            keys: list[_Key] = [("content", source_marks(scene.dataset, known)[name])]
        else:
            name = scene.name
            keys = [("content", sha256_of(np.ascontiguousarray(scene.read()[0], np.float32)))] if seen else []
        if named:
            keys.append(("name", PurePosixPath(name).stem.lower()))
        listed.append((name, keys))
    return listed


def _place(scenes: SceneSet) -> str:
    return scenes.location.rstrip("/") if "://" in scenes.location else str(Path(scenes.location).resolve())


@dataclass(frozen=True)
class FoundPicture:
    """A source picture of a data set that was found again.

    - `name`: its name in the data set.
    - `path`: its file; None for a picture of random colours, which is made again.
    - `height`, `width`: its size in the data set, px.
    - `preparation`: how it was prepared.
    """

    name: str
    path: Path | None
    height: int
    width: int
    preparation: Preparation

    def codes(self, crop: int = 0) -> npt.NDArray[np.uint8]:
        """Return the sRGB codes (H, W, 3) uint8 that images of the data set were made of: those of one of its crops."""
        if self.path is None:
            number = int(self.name.rpartition("-")[2])
            return RandomScene(number, self.width, self.height, self.preparation.seed).read().picture
        reading = open_picture(self.path, self.preparation, self.name)
        picture = reading.cuts[crop].picture if reading.cuts else reading.picture
        if picture.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{self.path} comes to {picture.shape[1]}x{picture.shape[0]} px where images of it are "
                f"{self.width}x{self.height}; use the release that made the data set"
            )
        return picture


def find_sources(dataset: Dataset, place: Path | str) -> tuple[Mapping[str, FoundPicture], tuple[str, ...]]:
    """Return the source pictures of a data set that a folder holds, by name, and the names of those that it lacks.

    A picture is the one that is meant if its bytes have the hash that the data set records; a file of that name is
    tried first, then files of other names. Pictures of random colours need no file.
    """
    preparation = preparation_of(dataset.description)
    if "://" in str(place):
        raise InputError(f"{place} is no folder of this machine; copy the pictures to one")
    # A set of random colours needs no folder, but one that is named must be there.
    files = {file.name: Path(file.location) for file in find_pictures(place)}

    @cache
    def hash_of(name: str) -> str:
        try:
            return file_sha256(files[name])
        except OSError as error:
            told = os.strerror(error.errno or 0)
            raise InputError(f"cannot read {files[name]}: {told}; name another folder") from error

    @cache
    def by_hash() -> Mapping[str, Path]:
        return {hash_of(name): path for name, path in files.items()}

    found: dict[str, FoundPicture] = {}
    missing: list[str] = []
    for record in dataset.sources:
        path = None
        if record.sha256 is not None:
            same = record.name in files and hash_of(record.name) == record.sha256
            path = files[record.name] if same else by_hash().get(record.sha256)
        if path is None and record.sha256 is not None:
            missing.append(record.name)
        else:
            found[record.name] = FoundPicture(record.name, path, record.height, record.width, preparation)
    return found, tuple(missing)


_LINEAR: Final = decode_srgb(np.arange(256) / 255)  # Linear light 0 … 1 of each code


def naive_image(
    codes: npt.NDArray[np.uint8],
    light: npt.NDArray[np.floating],
    saturation: float,
    matrix: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the naive raw image of a picture under a light.

    `codes`: (H, W, 3) uint8, sRGB codes. `light`: (3,) or (H, W, 3) float, linear camera RGB that code 255, 255, 255 is
    to have, in counts. `matrix`: (3, 3) float64, linear sRGB to camera RGB with rows of sum 1; None leaves colours as
    they are. Returns (H, W, 3) uint16, rounded to whole counts, 0 … `saturation`.

    Examples
    --------
    >>> codes = np.array([[[255, 255, 255], [188, 0, 255]]], np.uint8)
    >>> naive_image(codes, np.array([1000.0, 2000.0, 500.0]), saturation=1800)
    array([[[1000, 1800,  500],
            [ 503,    0,  500]]], dtype=uint16)
    """
    linear = _LINEAR[codes]
    if matrix is not None:
        # A colour outside of what the camera tells apart would be darker than black.
        linear = np.maximum(linear @ matrix.T, 0)
    return np.clip(np.rint(linear * light), 0, np.floor(saturation)).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class NaiveScene:
    """The naive counterpart of an image of a generated data set; made when it is read.

    - `generated`: the image whose counterpart it is.
    - `matrix`: the camera's colour matrix, or None.
    """

    generated: GeneratedScene
    picture: FoundPicture
    matrix: ColourMatrix | None = None

    @property
    def name(self) -> str:
        """The name of the generated image."""
        return self.generated.name

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64 of the generated image, linear camera RGB, r + g + b = 1."""
        return self.generated.truth

    @property
    def saturation(self) -> float:
        """The white level of the generated image, counts."""
        return self.generated.saturation

    @cached_property
    def whites(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64 of the image, counts of the table's white reference."""
        entry, description = self.generated.entry, self.generated.dataset.description
        levels = {light.illumination: sum(light.white) for light in description.lights}
        whites: list[npt.NDArray[np.float64]] = []
        for label, truth in zip(entry.lights, entry.truths, strict=True):
            mixture = parse_mixture(label)
            if not levels.keys() >= set(mixture.lights):
                raise FormatError(
                    f"{entry.image} is under light {label}, which its data set does not list; make it again"
                )
            level = sum(weight * levels[light] for light, weight in zip(mixture.lights, mixture.weights, strict=True))
            whites.append(np.array(truth) * level)
        return np.array(whites)

    @property
    def _details(self) -> Mapping[str, str]:
        """What options did to the generated image, by column of `images.csv`."""
        return self.generated.dataset.details.get(self.generated.entry.image, {})

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, counts, and no mask."""
        light = self.whites[0]
        if len(self.whites) > 1:
            light = self.generated.dataset.read_weights(self.generated.entry) @ self.whites
        matrix = None if self.matrix is None else self.matrix.rows
        codes = self.picture.codes(int(self._details.get("crop", 0)))
        return naive_image(codes, light, self.saturation, matrix), None


@dataclass(frozen=True, eq=False)
class NaiveMixedScene(NaiveScene):
    """The naive counterpart of an image that several lights fall on."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.generated.entry.truths)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the share of each light in each pixel: (H, W, K) float32, 0 … 1, sum 1."""
        return self.generated.dataset.read_weights(self.generated.entry)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1."""
        return self.generated.dataset.read_ground_truth_map(self.generated.entry)


def naive_scenes(
    scenes: Sequence[GeneratedScene], found: Mapping[str, FoundPicture], matrix: ColourMatrix | None = None
) -> tuple[NaiveScene, ...]:
    """Return the naive counterparts of generated images, in their order; images without a picture must be left out.

    `matrix`: the camera's colour matrix, or None.
    """
    return tuple(
        (NaiveScene if len(scene.entry.lights) == 1 else NaiveMixedScene)(scene, found[scene.entry.source], matrix)
        for scene in scenes
    )


@dataclass(frozen=True, eq=False)
class RelitScene:
    """A real scene of another camera under a light of a generated image, by von Kries: over its own light, times that.

    - `scene`: the real scene.
    - `truth`: (3,) float64, the generated image's ground truth, linear camera RGB.
    - `name`: a name of its own, since a scene may be lit several times.
    - `saturation`: none: what was clipped is masked, since channels were scaled apart.
    """

    scene: Scene
    truth: npt.NDArray[np.float64]
    name: str
    saturation: None = None

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3) float32, and its mask (H, W) bool."""
        image, mask = self.scene.read()
        own = self.scene.truth / self.scene.truth.sum()
        if self.scene.saturation is not None:
            clipped: npt.NDArray[np.bool_] = np.asarray((image >= self.scene.saturation).any(axis=2))
            mask = clipped if mask is None else mask | clipped
        return (image * (self.truth / self.truth.sum() / own)).astype(np.float32), mask


def relit_scenes(scenes: Sequence[Scene], lights: Sequence[npt.NDArray[np.float64]]) -> tuple[RelitScene, ...]:
    """Return a scene for each light (3,) float64, in the lights' order; each scene is lit about equally often."""
    random = np.random.default_rng(0)
    rounds = [random.permutation(len(scenes)) for _ in range(-(-len(lights) // len(scenes)))]
    places: list[int] = np.concatenate(rounds)[: len(lights)].tolist()
    return tuple(
        RelitScene(scenes[place], light, f"{number}_{scenes[place].name}")
        for number, (place, light) in enumerate(zip(places, lights, strict=True))
    )


@dataclass(frozen=True, eq=False)
class TransferPlan:
    """Training sets that may be trained on, and what was done to make them so.

    - `training`: for each set itself and, where it was generated and there are pictures, its naive counterparts; images
      that were left out are in none of them.
    - `sets`: the data sets as they were opened.
    - `notes`: sentences for the reader: images left out, matrices used, cautions.
    """

    training: tuple[TrainingSet, ...]
    sets: tuple[SceneSet, ...]
    notes: tuple[str, ...]


def is_generated(some: SceneSet) -> bool:
    """Return whether images of a set were made by `generate`."""
    return any(isinstance(scene, GeneratedScene) for scene in some.scenes)


def plan_transfer(
    test: SceneSet, sets: Sequence[SceneSet], pictures: Path | str | None = None, relit: SceneSet | None = None
) -> TransferPlan:
    """Return the training sets of a transfer.

    `pictures`: folder of the source pictures of the generated sets, for the naive baseline; None for no such baseline.
    `relit`: real scenes of another camera, to be lit by the lights of each generated set; None for no such yardstick.
    """
    names = [some.name for some in sets]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"two training sets are called {first_of(twice)}; rename the folder of one: names head the rows"
        )
    training: list[TrainingSet] = []
    notes: list[str] = []
    if is_generated(test):
        notes.append(f"The test set {test.name} was made by generate: nothing here says what is reached on real images")
    for some in sets:
        scenes = _trainable(some, test, notes)
        made = tuple(scene for scene in scenes if isinstance(scene, GeneratedScene))
        if not made:
            training.append(TrainingSet(some.name, "other", scenes))
            notes.append(f"{some.name} was not made by generate: its rows say nothing of generated images")
        elif pictures is None:
            training.append(TrainingSet(some.name, "generated", made))
        else:
            training += _with_naive(some.name, made, pictures, notes)
        if made and relit is not None:
            others = _trainable(relit, test, notes)
            lights = [scene.truth for scene in training[-1].scenes]
            training.append(TrainingSet(some.name, "relit", relit_scenes(others, lights)))
            notes.append(
                f"{some.name}: {len(others)} scenes of {relit.name}, relit to the lights of its {len(lights)} images"
            )
    if pictures is not None and all(each.kind == "other" for each in training):
        raise InputError("--naive is for sets made by generate, and TRAIN names none; leave it out")
    return TransferPlan(tuple(training), tuple(sets), tuple(notes))


def _trainable(some: SceneSet, test: SceneSet, notes: list[str]) -> tuple[Scene, ...]:
    kept, shared = trainable_images(some, test)
    if shared:
        notes.append(f"{shared}; left out")
    divided = [
        scene for scene in kept if isinstance(scene, GeneratedScene) and scene.entry.split not in (None, "train")
    ]
    if divided:
        notes.append(f"{some.name}: {len(divided)} images of its parts validation and test are not trained on")
        left_out = {id(scene) for scene in divided}
        kept = tuple(scene for scene in kept if id(scene) not in left_out)
    if not kept:
        raise InputError(f"{some.name} has no image left to train on: all are shared with the test set or set apart")
    return kept


def _with_naive(name: str, made: Sequence[GeneratedScene], pictures: Path | str, notes: list[str]) -> list[TrainingSet]:
    """Return a generated set's images and their naive counterparts, all of the pictures that were found."""
    dataset = made[0].dataset
    if dataset.description.options.get("variation", {}).get("gradient"):
        raise InputError(f"{name} was made with a gradient, which naive images have not; leave out --naive")
    found, missing = find_sources(dataset, pictures)
    kept = tuple(scene for scene in made if scene.entry.source in found)
    if not kept:
        raise InputError(
            f"none of the {len(missing)} pictures of {name} is in {pictures}, by name and hash: "
            f"{first_of(missing, 3)}; name the folder that the data set was made from"
        )
    if missing:
        notes.append(
            f"{name}: {len(missing)} of {len(missing) + len(found)} pictures are not in {pictures}: "
            f"{first_of(missing)}; {len(made) - len(kept)} images of them are left out of its every row"
        )
    sets = [
        TrainingSet(name, "generated", kept),
        TrainingSet(name, "naive", naive_scenes(kept, found)),
    ]
    camera = dataset.description.table.camera
    matrix = camera_matrix(camera)
    if matrix is None:
        notes.append(f"{name}: no colour matrix is known for {camera}, so no row has one")
        return sets
    rows = "; ".join(" ".join(f"{part:.3f}" for part in row) for row in matrix.rows)
    notes.append(f"{name}: colour matrix of {matrix.name}, {matrix.source}, rows of sum 1: {rows}")
    return [*sets, TrainingSet(name, "naive with matrix", naive_scenes(kept, found, matrix))]
