"""Read and write model files: arrays of a fitted method with a record of its training.

A model file is a NumPy `.npz` without pickled objects, so opening it runs no code. It has the arrays of the model by
name. The array `about` is a JSON text with the method, its settings and the provenance. All parts are checked when
read.
"""

from __future__ import annotations

import dataclasses
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, PlainValidator

from evaluation.datasets.identity import identities
from evaluation.learning.adapting import restore
from evaluation.learning.feature_learner import FeatureLearner, LearnedMethod
from evaluation.learning.standard import standard_learners
from evaluation.methods.method import Method
from evaluation.scene import Scene, SceneSet
from foundation.arrays import native
from foundation.clock import Clock
from foundation.errors import FormatError, InputError
from foundation.files import atomic_file, sha256_of
from foundation.folders import require_free_file
from foundation.records import from_plain, to_plain
from foundation.version import software

_FORMAT = "croplab model 1"
_ABOUT = "about"
_IDENTITIES = "trained_on"
_REMEDY = "give a file made by evaluate train"


# Hashes that identify the training images. They are stored as an array, not in the JSON text.
_Identities = Annotated[npt.NDArray[np.uint64], PlainValidator(np.asarray), Field(exclude=True)]


@dataclass(frozen=True)
class TrainingRecord:
    """Record of the training of a model.

    - `data_name`, `data_place`, `data_layout`: name, location and layout of the data set, see `scene.SceneSet`.
    - `treatment`: treatment of its images, see `scene.SceneSet`.
    - `scenes`: number of images.
    - `sha256`: hash of names and ground truths, see `scenes_sha256`.
    - `part`: part of the data set: "all", or the folds that were used.
    - `seed`: seed of the fit.
    - `software`: name and version of the program.
    - `date`: ISO 8601, UTC.
    - `adapted_from`: description of the training of the pretrained model; empty if the model was not adapted.
    - `images`: (N, 2) uint64, identities of the images, see `datasets.identity`.
    """

    data_name: str
    data_place: str
    data_layout: str
    treatment: Mapping[str, str]
    scenes: int
    sha256: str
    part: str
    seed: int
    software: str
    date: str
    adapted_from: str = ""
    images: _Identities = field(default_factory=lambda: np.empty((0, 2), np.uint64), compare=False)

    def description(self) -> str:
        """Return the record as one line of text."""
        return (
            f"trained on {self.part} of {self.data_name} ({self.data_layout}, {self.scenes} images, seed {self.seed}) "
            f"by {self.software} on {self.date[:10]}"
            + (f", adapted from a model {self.adapted_from}" if self.adapted_from else "")
        )


@dataclass(frozen=True, eq=False)
class StoredMethod(LearnedMethod):
    """Fitted method from a model file; `provenance` is the record of its training."""

    provenance: TrainingRecord | None = None


def provenance_of(
    data: SceneSet, seed: int, clock: Clock, adapted_from: TrainingRecord | None = None
) -> TrainingRecord:
    """Return the record of a training on a data set; with `adapted_from`, its images are added."""
    images = identities(data.scenes)
    return TrainingRecord(
        data_name=data.name,
        data_place=data.location,
        data_layout=data.layout,
        treatment=dict(data.treatment),
        scenes=len(data.scenes),
        sha256=scenes_sha256(data.scenes),
        part="all",
        seed=seed,
        software=software(),
        date=clock.now().isoformat(timespec="seconds"),
        adapted_from=adapted_from.description() if adapted_from else "",
        images=np.concatenate([images, adapted_from.images]) if adapted_from else images,
    )


def scenes_sha256(scenes: Sequence[Scene]) -> str:
    """Return the SHA-256 of names and ground truths of scenes, 64 hexadecimal digits.

    Ground truths are hashed as chromaticities with nine digits, so that their length does not matter.
    """
    truths = [np.asarray(scene.truth, dtype=np.float64) for scene in scenes]
    shares = [" ".join(f"{value:.9f}" for value in truth / truth.sum()) for truth in truths]
    lines = [f"{scene.name}\t{share}" for scene, share in zip(scenes, shares, strict=True)]
    return sha256_of("\n".join(lines).encode())


def save_model(path: Path, method: Method, provenance: TrainingRecord) -> None:
    """Write a fitted method to a new model file.

    Raises InputError if the method is not one of `standard_learners` or the path exists, and StorageError if the disk
    cannot be written.
    """
    if not isinstance(method, LearnedMethod) or method.learner.key not in standard_learners():
        raise InputError(
            f"{method.name} cannot be saved, expected one of {', '.join(standard_learners())}; save the model of your "
            "own class in your code, or train and evaluate it with evaluate cv"
        )
    require_free_file(path, "the model")
    about = {
        "format": _FORMAT,
        "method": method.learner.key,
        "settings": settings_of(method.learner),
        "provenance": to_plain(provenance),
    }
    arrays: dict[str, Any] = {
        _ABOUT: np.array(json.dumps(about, indent=1, sort_keys=True)),
        _IDENTITIES: provenance.images,
        **method.model.arrays(),
    }
    with atomic_file(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def load_model(path: Path) -> StoredMethod:
    """Return the fitted method in a model file; raise FormatError if it does not exist or is not valid."""
    try:
        arrays = _read_arrays(path)
        about = json.loads(str(arrays.pop(_ABOUT)))
        if about["format"] != _FORMAT:
            raise ValueError(f"its format is {about['format']!r}, expected {_FORMAT!r}")
        learners = standard_learners()
        if about["method"] not in learners:
            raise ValueError(f"its method is {about['method']!r}, expected {', '.join(learners)}")
        learner = _apply_settings(learners[about["method"]], about["settings"])
        images = arrays.pop(_IDENTITIES)
        provenance = from_plain(TrainingRecord, about["provenance"] | {"images": images}, path, _REMEDY)
        # Adapted models have the images of both trainings.
        is_complete = len(images) == provenance.scenes or (provenance.adapted_from and len(images) > provenance.scenes)
        if images.dtype != np.uint64 or images.shape[1:] != (2,) or not is_complete:
            raise ValueError(
                f"its {_IDENTITIES} is {images.dtype} of the shape {images.shape}, expected uint64, (images, 2)"
            )
        model = restore(learner, arrays)
    except (FileNotFoundError, IsADirectoryError) as error:
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise FormatError(f"{path} {problem}, expected a model file; {_REMEDY}") from error
    except KeyError as error:
        raise _damaged_file_error(path, f"it lacks {error}") from error
    except (
        *(OSError, ValueError, TypeError, AttributeError, EOFError, zlib.error, zipfile.BadZipFile),
        *(RuntimeError, NotImplementedError),  # encrypted, or compressed with an unsupported method
    ) as error:
        raise _damaged_file_error(path, _reason(error)) from error
    trained_on = provenance.data_name + (", adapted from another model" if provenance.adapted_from else "")
    return StoredMethod(learner, model, trained_on, provenance)


def _reason(error: Exception) -> str:
    message = (isinstance(error, OSError) and error.strerror) or str(error)
    return message.splitlines()[0] if message else type(error).__name__


def _damaged_file_error(path: Path, reason: str) -> FormatError:
    return FormatError(f"{path} is not a valid model file: {reason}; {_REMEDY}")


def _read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        # This check comes first, because numpy.load does not check the whole archive.
        if (damaged := archive.testzip()) is not None:
            raise ValueError(f"{damaged} is damaged")
    with np.load(path, allow_pickle=False) as content:
        return {name: native(content[name]) for name in content.files}


def settings_of(learner: FeatureLearner) -> dict[str, Any]:
    """Return the settings of a learner by name, as JSON values."""
    if not dataclasses.is_dataclass(learner):
        raise TypeError(f"{learner.name} is {type(learner).__name__}, expected a dataclass with settings as fields")
    return {setting.name: getattr(learner, setting.name) for setting in dataclasses.fields(learner)}


def _apply_settings(learner: FeatureLearner, settings: Mapping[str, Any]) -> FeatureLearner:
    expected = settings_of(learner)
    if set(settings) != set(expected):
        raise ValueError(f"its settings are {', '.join(sorted(settings))}, expected {', '.join(sorted(expected))}")
    for name, value in settings.items():
        if type(value) is not type(expected[name]):
            raise ValueError(f"setting {name} is {value!r}, expected a value like {expected[name]!r}")
    return type(learner)(**settings)
