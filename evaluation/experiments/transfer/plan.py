"""Plan a transfer: open and compare data sets, and select the images that may be used for training.

A method must not be trained on a test image or on its scene. Images are compared by their sources:

- two generated sets: by the hash of the source picture;
- a generated and a real set: by name, because an image that was generated from a photograph shows the same scene;
- two real sets: by name and by pixels.

Names are compared without folder and extension, and without regard to case.

The naive baseline has a counterpart of each generated image: the same picture under the same illuminant, with the same
brightness and quantisation, but without print, camera and noise. The codes of the picture are converted to linear light
by the sRGB curve, and optionally to camera RGB by a colour matrix. Each channel is multiplied by the illuminant. The
difference between training on generated images and on counterparts is the benefit of the look-up table (LUT). A
counterpart with several illuminants uses the masks of the generated image. `generate --exposure` and `--iso` are not
applied to counterparts.
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
from evaluation.datasets.identity import source_digests
from evaluation.experiments.transfer.rows import TrainingSet
from evaluation.scene import Scene, SceneSet
from foundation.colorimetry import decode_srgb
from foundation.errors import FormatError, InputError, first_few
from foundation.files import file_sha256, sha256_of
from generator.dataset.reader import Dataset
from generator.dataset.same_lights import preparation_of
from generator.lights.lighting import parse_mixture
from generator.pictures.random_scenes import RandomScene
from generator.pictures.sources import Preparation, find_pictures, open_picture
from generator.rendering.matrices import ColourMatrix, camera_matrix


@dataclass(frozen=True)
class SharedImage:
    """A training image with the same picture or scene as a test image."""

    position: int  # Index in the training set, from 0
    name: str  # Name of the training image, or of its source picture
    test: str  # Name of the test image, or of its source picture
    by: str  # Property that is equal: "name" or "content"


def shared_images(training: SceneSet, test: SceneSet) -> tuple[SharedImage, ...]:
    """Return the training images that share a picture or a scene with test images.

    Pixels are read only if both sets are real.
    """
    if _resolved_location(training) == _resolved_location(test):
        raise InputError(
            f"{test.location} is both training and test set, expected different sets; use evaluate cv to "
            "cross-validate on one set"
        )
    are_generated = [isinstance(scene_set.scenes[0], GeneratedScene) for scene_set in (training, test)]
    # Generated sets have hashes of their source pictures. Names are compared if a set is real, pixels if both are real.
    with_names, with_pixels = not all(are_generated), not any(are_generated)
    tests = {key: name for name, keys in _image_keys(test, with_names, with_pixels) for key in keys}
    shared: list[SharedImage] = []
    for position, (name, keys) in enumerate(_image_keys(training, with_names, with_pixels)):
        match = next(((tests[key], key[0]) for key in keys if key in tests), None)
        if match:
            shared.append(SharedImage(position, name, *match))
    return tuple(shared)


def trainable_images(
    training: SceneSet, test: SceneSet, leave_out: bool = True, test_name: str = "the test set"
) -> tuple[tuple[Scene, ...], str]:
    """Return the images of a set that may be used for training, and a note on images shared with the test set, or "".

    `leave_out`: True excludes shared images. False keeps images with equal names; equal content raises InputError.
    """
    common = shared_images(training, test)
    if not common:
        return training.scenes, ""
    names = first_few([image.name for image in common], 3)
    count = f"{len(common)} of {len(training.scenes)} images of {training.name}"
    note = f"{count} are also in {test_name}, by {common[0].by}: {names}"
    if leave_out:
        shared_positions = {image.position for image in common}
        return tuple(scene for position, scene in enumerate(training.scenes) if position not in shared_positions), note
    if any(image.by == "content" for image in common):
        raise InputError(f"{note}, expected no test image in the training set; use --unseen to exclude shared images")
    return training.scenes, note


_Key = tuple[str, str]  # ("name", name) or ("content", hash)


def _image_keys(scenes: SceneSet, with_names: bool, with_pixels: bool) -> list[tuple[str, list[_Key]]]:
    """Return the name of each image, or of its source picture, with its keys for comparison."""
    digests: dict[int, Mapping[str, str]] = {}
    image_keys: list[tuple[str, list[_Key]]] = []
    for scene in scenes.scenes:
        if isinstance(scene, GeneratedScene):
            name = scene.entry.source
            keys: list[_Key] = [("content", source_digests(scene.dataset, digests)[name])]
        else:
            name = scene.name
            keys = [("content", sha256_of(np.ascontiguousarray(scene.read()[0], np.float32)))] if with_pixels else []
        if with_names:
            keys.append(("name", PurePosixPath(name).stem.lower()))
        image_keys.append((name, keys))
    return image_keys


def _resolved_location(scenes: SceneSet) -> str:
    return scenes.location.rstrip("/") if "://" in scenes.location else str(Path(scenes.location).resolve())


@dataclass(frozen=True)
class FoundPicture:
    """A source picture of a data set, located in a folder."""

    name: str
    path: Path | None  # Its file; None for a picture of random colours, which is generated again
    # Its size in the data set, px
    height: int
    width: int
    preparation: Preparation

    def codes(self, crop: int = 0) -> npt.NDArray[np.uint8]:
        """Return the sRGB codes (H, W, 3) uint8 of the prepared picture, or of its crop number `crop`."""
        if self.path is None:
            number = int(self.name.rpartition("-")[2])
            return RandomScene(number, self.width, self.height, self.preparation.seed).read().picture
        reading = open_picture(self.path, self.preparation, self.name)
        picture = reading.cuts[crop].picture if reading.cuts else reading.picture
        if picture.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{self.path} is prepared to {picture.shape[1]}x{picture.shape[0]} px, expected "
                f"{self.width}x{self.height} px, as in the data set; use the release that made the data set"
            )
        return picture


def find_source_pictures(dataset: Dataset, folder: Path | str) -> tuple[Mapping[str, FoundPicture], tuple[str, ...]]:
    """Return the source pictures of a data set in a folder, by name, and the names of missing ones.

    A file is identified by its recorded hash. The file with the recorded name is tried first. Pictures of random
    colours need no file.
    """
    preparation = preparation_of(dataset.description)
    if "://" in str(folder):
        raise InputError(f"{folder} is a URL, expected a folder of this machine; copy the pictures to one")
    # Random colours need no folder, but if a folder is given, it must exist.
    files = {file.name: Path(file.location) for file in find_pictures(folder)}

    @cache
    def hash_of(name: str) -> str:
        try:
            return file_sha256(files[name])
        except OSError as error:
            reason = os.strerror(error.errno or 0)
            raise InputError(f"cannot read {files[name]}: {reason}; give another folder") from error

    @cache
    def by_hash() -> Mapping[str, Path]:
        return {hash_of(name): path for name, path in files.items()}

    found_pictures: dict[str, FoundPicture] = {}
    missing: list[str] = []
    for record in dataset.sources:
        path = None
        if record.sha256 is not None:
            is_same_file = record.name in files and hash_of(record.name) == record.sha256
            path = files[record.name] if is_same_file else by_hash().get(record.sha256)
        if path is None and record.sha256 is not None:
            missing.append(record.name)
        else:
            found_pictures[record.name] = FoundPicture(record.name, path, record.height, record.width, preparation)
    return found_pictures, tuple(missing)


_LINEAR_OF_CODE: Final = decode_srgb(np.arange(256) / 255)  # Linear light 0 … 1 of each code


def naive_image(
    codes: npt.NDArray[np.uint8],
    light: npt.NDArray[np.floating],
    saturation: float,
    matrix: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the naive raw image (H, W, 3) uint16 of a picture under an illuminant: whole counts, 0 … `saturation`.

    `codes`: (H, W, 3) uint8, sRGB. `light`: (3,) or (H, W, 3) float, camera RGB of code 255, 255, 255, counts.
    `matrix`: (3, 3) float64, linear sRGB to camera RGB with rows of sum 1; None keeps linear sRGB.

    Examples
    --------
    >>> codes = np.array([[[255, 255, 255], [188, 0, 255]]], np.uint8)
    >>> naive_image(codes, np.array([1000.0, 2000.0, 500.0]), saturation=1800)
    array([[[1000, 1800,  500],
            [ 503,    0,  500]]], dtype=uint16)
    """
    linear = _LINEAR_OF_CODE[codes]
    if matrix is not None:
        # The matrix gives negative values for colours outside the camera's gamut.
        linear = np.maximum(linear @ matrix.T, 0)
    return np.clip(np.rint(linear * light), 0, np.floor(saturation)).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class NaiveScene:
    """Naive counterpart of a generated image; the image is calculated when it is read."""

    generated: GeneratedScene
    picture: FoundPicture
    matrix: ColourMatrix | None = None  # Colour matrix of the camera, or None

    @property
    def name(self) -> str:
        """Name of the generated image."""
        return self.generated.name

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Ground truth (3,) float64 of the generated image, linear camera RGB, r + g + b = 1."""
        return self.generated.truth

    @property
    def saturation(self) -> float:
        """Saturation level of the generated image, counts."""
        return self.generated.saturation

    @cached_property
    def whites(self) -> npt.NDArray[np.float64]:
        """Camera RGB (K, 3) float64 of the LUT's white reference under each illuminant of the image, counts."""
        entry, description = self.generated.entry, self.generated.dataset.description
        levels = {light.illumination: sum(light.white) for light in description.lights}
        whites: list[npt.NDArray[np.float64]] = []
        for label, truth in zip(entry.lights, entry.truths, strict=True):
            mixture = parse_mixture(label)
            if not levels.keys() >= set(mixture.lights):
                raise FormatError(
                    f"{entry.image} is under illuminant {label}, which its data set does not list, expected a listed "
                    "one; generate the data set again"
                )
            level = sum(weight * levels[light] for light, weight in zip(mixture.lights, mixture.weights, strict=True))
            whites.append(np.array(truth) * level)
        return np.array(whites)

    @property
    def _details(self) -> Mapping[str, str]:
        # Options that were applied to the generated image, by column of images.csv.
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
    """Naive counterpart of an image under several illuminants."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """Illuminants (K, 3) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.generated.entry.truths)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the weight of each illuminant in each pixel: (H, W, K) float32, 0 … 1, sum 1."""
        return self.generated.dataset.read_weights(self.generated.entry)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the illuminant of each pixel: (H, W, 3) float32, r + g + b = 1."""
        return self.generated.dataset.read_ground_truth_map(self.generated.entry)


def naive_scenes(
    scenes: Sequence[GeneratedScene], pictures: Mapping[str, FoundPicture], matrix: ColourMatrix | None = None
) -> tuple[NaiveScene, ...]:
    """Return the naive counterparts of generated images, in their order; every image needs a picture."""
    return tuple(
        (NaiveScene if len(scene.entry.lights) == 1 else NaiveMixedScene)(scene, pictures[scene.entry.source], matrix)
        for scene in scenes
    )


@dataclass(frozen=True, eq=False)
class RelitScene:
    """A real scene of another camera under the illuminant of a generated image, by von Kries scaling."""

    scene: Scene
    truth: npt.NDArray[np.float64]  # (3,) float64, ground truth of the generated image, linear camera RGB
    name: str  # Name of the relit image; a scene may be used several times
    saturation: None = None  # Clipped pixels are masked instead, because channels are scaled differently

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3) float32, and its mask (H, W) bool."""
        image, mask = self.scene.read()
        own_illuminant = self.scene.truth / self.scene.truth.sum()
        if self.scene.saturation is not None:
            clipped: npt.NDArray[np.bool_] = np.asarray((image >= self.scene.saturation).any(axis=2))
            mask = clipped if mask is None else mask | clipped
        return (image * (self.truth / self.truth.sum() / own_illuminant)).astype(np.float32), mask


def relit_scenes(scenes: Sequence[Scene], lights: Sequence[npt.NDArray[np.float64]]) -> tuple[RelitScene, ...]:
    """Return one relit scene for each illuminant (3,) float64; each scene is used about equally often."""
    random = np.random.default_rng(0)
    rounds = [random.permutation(len(scenes)) for _ in range(-(-len(lights) // len(scenes)))]
    scene_indices: list[int] = np.concatenate(rounds)[: len(lights)].tolist()
    return tuple(
        RelitScene(scenes[scene_index], light, f"{index}_{scenes[scene_index].name}")
        for index, (scene_index, light) in enumerate(zip(scene_indices, lights, strict=True))
    )


@dataclass(frozen=True, eq=False)
class TransferPlan:
    """Training sets of a transfer, and the notes on their preparation."""

    # Excluded images are already removed. A generated set is followed by its naive and relit sets, if requested
    training: tuple[TrainingSet, ...]
    sets: tuple[SceneSet, ...]  # The data sets as opened
    notes: tuple[str, ...]  # Excluded images, colour matrices and cautions, as sentences


def is_generated(scene_set: SceneSet) -> bool:
    """Return True if any image of the set was made by `generate`."""
    return any(isinstance(scene, GeneratedScene) for scene in scene_set.scenes)


def plan_transfer(
    test: SceneSet, sets: Sequence[SceneSet], pictures: Path | str | None = None, relit: SceneSet | None = None
) -> TransferPlan:
    """Return the training sets of a transfer.

    `pictures`: folder of the source pictures of the generated sets, for the naive baseline; None for no baseline.
    `relit`: real scenes of another camera, relit to the illuminants of each generated set, for comparison; or None.
    """
    names = [scene_set.name for scene_set in sets]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(
            f"two training sets have the name {first_few(repeated)}, expected different names; rename one folder"
        )
    training: list[TrainingSet] = []
    notes: list[str] = []
    if is_generated(test):
        notes.append(f"The test set {test.name} was made by generate: no number here is a result on real images")
    for scene_set in sets:
        scenes = _trainable(scene_set, test, notes)
        generated = tuple(scene for scene in scenes if isinstance(scene, GeneratedScene))
        if not generated:
            training.append(TrainingSet(scene_set.name, "other", scenes))
            notes.append(f"{scene_set.name} was not made by generate: its rows are not results of generated images")
        elif pictures is None:
            training.append(TrainingSet(scene_set.name, "generated", generated))
        else:
            training += _with_naive(scene_set.name, generated, pictures, notes)
        if generated and relit is not None:
            relit_sources = _trainable(relit, test, notes)
            lights = [scene.truth for scene in training[-1].scenes]
            training.append(TrainingSet(scene_set.name, "relit", relit_scenes(relit_sources, lights)))
            notes.append(
                f"{scene_set.name}: {len(relit_sources)} scenes of {relit.name}, relit to the illuminants of its "
                f"{len(lights)} images"
            )
    if pictures is not None and all(training_set.kind == "other" for training_set in training):
        raise InputError("--naive is given without a TRAIN made by generate, expected at least one; omit --naive")
    return TransferPlan(tuple(training), tuple(sets), tuple(notes))


def _trainable(scene_set: SceneSet, test: SceneSet, notes: list[str]) -> tuple[Scene, ...]:
    trainable, shared_note = trainable_images(scene_set, test)
    if shared_note:
        notes.append(f"{shared_note}; excluded")
    held_out = [
        scene for scene in trainable if isinstance(scene, GeneratedScene) and scene.entry.split not in (None, "train")
    ]
    if held_out:
        notes.append(f"{scene_set.name}: {len(held_out)} images of its validation and test parts are excluded")
        held_out_ids = {id(scene) for scene in held_out}
        trainable = tuple(scene for scene in trainable if id(scene) not in held_out_ids)
    if not trainable:
        raise InputError(
            f"{scene_set.name} has 0 images outside its test parts and the test set, expected at least 1; use another "
            "set"
        )
    return trainable


def _with_naive(name: str, images: Sequence[GeneratedScene], folder: Path | str, notes: list[str]) -> list[TrainingSet]:
    """Return the generated images with a picture in the folder, and their naive counterparts."""
    dataset = images[0].dataset
    if dataset.description.options.get("variation", {}).get("gradient"):
        # Naive images have the same brightness everywhere.
        raise InputError(f"{name} was made with a gradient, expected none for naive images; omit --naive")
    found_pictures, missing = find_source_pictures(dataset, folder)
    with_picture = tuple(scene for scene in images if scene.entry.source in found_pictures)
    if not with_picture:
        raise InputError(
            f"0 of {len(missing)} pictures of {name} are in {folder}, by hash (missing: "
            f"{first_few(missing, 3)}), expected the folder that the data set was made from; use that folder"
        )
    if missing:
        notes.append(
            f"{name}: {len(missing)} of {len(missing) + len(found_pictures)} pictures are not in {folder}: "
            f"{first_few(missing)}; {len(images) - len(with_picture)} images of these are excluded from all rows"
        )
    sets = [
        TrainingSet(name, "generated", with_picture),
        TrainingSet(name, "naive", naive_scenes(with_picture, found_pictures)),
    ]
    camera = dataset.description.table.camera
    matrix = camera_matrix(camera)
    if matrix is None:
        notes.append(f"{name}: no colour matrix of {camera} is available, so the rows with a matrix are omitted")
        return sets
    rows = "; ".join(" ".join(f"{value:.3f}" for value in row) for row in matrix.rows)
    notes.append(f"{name}: colour matrix of {matrix.name}, {matrix.source}, rows of sum 1: {rows}")
    return [*sets, TrainingSet(name, "naive with matrix", naive_scenes(with_picture, found_pictures, matrix))]
