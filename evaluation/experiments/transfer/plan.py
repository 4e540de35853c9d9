"""What a transfer is to be: data sets opened, compared and cut to what may be trained on, before the work begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from evaluation.datasets.generated import GeneratedScene
from evaluation.experiments.transfer.naive import naive_scenes
from evaluation.experiments.transfer.overlap import Shared, trainable_images
from evaluation.experiments.transfer.pictures import find_sources
from evaluation.experiments.transfer.rows import TrainingSet
from evaluation.scene import Scene, SceneSet
from foundation.errors import InputError, first_of
from generator.rendering.matrices import ColourMatrix, camera_matrix, choose_matrix


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
    test: SceneSet,
    sets: Sequence[SceneSet],
    pictures: Path | str | None = None,
    matrix: str | None = None,
    shared: Shared = "refuse",
) -> TransferPlan:
    """Return the training sets of a transfer.

    `pictures`: folder of the source pictures of the generated sets, for the naive baseline; None for no such baseline.
    `matrix`: A camera, a file or `none`, see `matrices.choose_matrix`; None for the matrix of the camera of each
    generated set's table, if it is known.
    """
    if not sets:
        raise InputError("no data set to train on: name at least one with --train")
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
        scenes = _trainable(some, test, shared, notes)
        made = tuple(scene for scene in scenes if isinstance(scene, GeneratedScene))
        if not made:
            training.append(TrainingSet(some.name, "other", scenes))
            notes.append(f"{some.name} was not made by generate: its rows say nothing of generated images")
        elif pictures is None:
            training.append(TrainingSet(some.name, "generated", made))
        else:
            training += _with_naive(some.name, made, pictures, matrix, notes)
    if pictures is not None and all(each.kind == "other" for each in training):
        raise InputError("--naive is for sets made by generate, and --train names none; leave it out")
    return TransferPlan(tuple(training), tuple(sets), tuple(notes))


def _trainable(some: SceneSet, test: SceneSet, shared: Shared, notes: list[str]) -> tuple[Scene, ...]:
    """Return the images of a set that may be trained on."""
    kept, told = trainable_images(some, test, shared)
    if told:
        notes.append(f"{told}; {'left out' if shared == 'leave-out' else 'kept: what is tested is not unseen'}")
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


def _with_naive(
    name: str, made: Sequence[GeneratedScene], pictures: Path | str, matrix: str | None, notes: list[str]
) -> list[TrainingSet]:
    """Return a generated set's images and their naive counterparts, all of the pictures that were found."""
    dataset = made[0].dataset
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
    chosen = _matrix_for(name, dataset.description.table.camera, matrix, notes)
    if chosen is not None:
        sets.append(TrainingSet(name, "naive with matrix", naive_scenes(kept, found, chosen)))
    return sets


def _matrix_for(name: str, camera: str, asked: str | None, notes: list[str]) -> ColourMatrix | None:
    """Return the colour matrix for a generated set's naive counterparts."""
    chosen = choose_matrix(asked) if asked is not None else camera_matrix(camera)
    if chosen is not None:
        rows = "; ".join(" ".join(f"{part:.3f}" for part in row) for row in chosen.rows)
        notes.append(f"{name}: colour matrix of {chosen.name}, {chosen.source}, rows of sum 1: {rows}")
    elif asked is None:
        notes.append(f"{name}: no colour matrix is known for {camera}; --matrix names one")
    return chosen
