"""Model files: what a learned method has learned, as plain arrays with the story of their training.

A model file is NumPy's `.npz` without pickled objects, so that opening one runs no code: the arrays of the model under
their own names, and under `about` a JSON text with the method, its settings and the provenance. Reading checks all of
it; a file that is foreign or damaged is refused in one sentence.
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
from foundation.clock import Clock
from foundation.errors import FormatError, InputError
from foundation.files import atomic_file, sha256_of
from foundation.folders import require_free_file
from foundation.records import from_plain, to_plain
from foundation.version import software

_FORMAT = "croplab model 1"
_ABOUT = "about"
_TRAINED = "trained_on"
_REMEDY = "name a file that evaluate train has made"


# An array beside the text, which says all else.
_Images = Annotated[npt.NDArray[np.uint64], PlainValidator(np.asarray), Field(exclude=True)]


@dataclass(frozen=True)
class TrainingRecord:
    """What a model was trained on, by what and when.

    - `data_name`, `data_place`, `data_layout`: the data set; see `scene.SceneSet`.
    - `treatment`: what was done to its images before the method saw them.
    - `scenes`: number of images.
    - `sha256`: of the images' names and ground truths, 64 hexadecimal digits; see `scenes_sha256`.
    - `part`: the part of the data set: "all", or which folds.
    - `seed`: of the fit.
    - `software`: name and version of what trained it.
    - `date`: ISO 8601, UTC.
    - `adapted_from`: of a model that was adapted: what the one that it was adapted from was trained on, in a sentence;
      else empty.
    - `images`: (N, 2) uint64, by what each image is known again, see `datasets.identity`.
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
    images: _Images = field(default_factory=lambda: np.empty((0, 2), np.uint64), compare=False)

    def sentence(self) -> str:
        """Return in one line what the model was trained on."""
        return (
            f"trained on {self.part} of {self.data_name} ({self.data_layout}, {self.scenes} images, seed {self.seed}) "
            f"by {self.software} on {self.date[:10]}"
            + (f", adapted from a model {self.adapted_from}" if self.adapted_from else "")
        )


@dataclass(frozen=True, eq=False)
class StoredMethod(LearnedMethod):
    """A learned method from a model file.

    - `provenance`: what it was trained on.
    """

    provenance: TrainingRecord | None = None


def provenance_of(
    data: SceneSet, seed: int, clock: Clock, adapted_from: TrainingRecord | None = None
) -> TrainingRecord:
    """Return the provenance of a model that is trained on a data set now.

    `adapted_from`: that of the model that is adapted; its images count among those that this one was trained on.
    """
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
        adapted_from=adapted_from.sentence() if adapted_from else "",
        images=np.concatenate([images, adapted_from.images]) if adapted_from else images,
    )


def scenes_sha256(scenes: Sequence[Scene]) -> str:
    """Return a hash of the names and ground truths of scenes, in their order: 64 hexadecimal digits.

    Truths count as chromaticities to nine digits, so that their length does not matter.
    """
    truths = [np.asarray(scene.truth, dtype=np.float64) for scene in scenes]
    shares = [" ".join(f"{part:.9f}" for part in truth / truth.sum()) for truth in truths]
    lines = [f"{scene.name}\t{share}" for scene, share in zip(scenes, shares, strict=True)]
    return sha256_of("\n".join(lines).encode())


def save_model(path: Path, method: Method, provenance: TrainingRecord) -> None:
    """Write a learned method to a new model file.

    Raises `InputError`: the method is not one of `standard_learners`, or something is at `path` already;
    `StorageError`: the disk is full, read-only or gone.
    """
    if not isinstance(method, LearnedMethod) or method.learner.key not in standard_learners():
        raise InputError(
            f"{method.name} cannot be saved: model files hold {', '.join(standard_learners())}; a class of your own "
            "keeps what it has learned by its own means, and is trained and evaluated by evaluate cv"
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
        _TRAINED: provenance.images,
        **method.model.arrays(),
    }
    with atomic_file(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def load_model(path: Path) -> StoredMethod:
    """Return the learned method of a model file.

    Raises `FormatError`: the file is not there, is no model file, or is damaged; the message says which.
    """
    try:
        arrays = _read_arrays(path)
        about = json.loads(str(arrays.pop(_ABOUT)))
        if about["format"] != _FORMAT:
            raise ValueError(f"it says {about['format']!r} where {_FORMAT!r} is expected")
        known = standard_learners()
        if about["method"] not in known:
            raise ValueError(f"it holds {about['method']!r}; known are {', '.join(known)}")
        learner = _with_settings(known[about["method"]], about["settings"])
        images = arrays.pop(_TRAINED)
        provenance = from_plain(TrainingRecord, about["provenance"] | {"images": images}, path, _REMEDY)
        # Of an adapted model they are those of both trainings.
        whole = len(images) == provenance.scenes or (provenance.adapted_from and len(images) > provenance.scenes)
        if images.dtype != np.uint64 or images.shape[1:] != (2,) or not whole:
            raise ValueError(
                f"its {_TRAINED} is {images.dtype} of the shape {images.shape}, expected uint64, (images, 2)"
            )
        model = restore(learner, arrays)
    except (FileNotFoundError, IsADirectoryError) as error:
        what = "a folder" if path.is_dir() else "not there"
        raise FormatError(f"{path} is {what}, expected a model file; {_REMEDY}") from error
    except KeyError as error:
        raise _refused(path, f"it lacks {error}") from error
    except (
        *(OSError, ValueError, TypeError, AttributeError, EOFError, zlib.error, zipfile.BadZipFile),
        *(RuntimeError, NotImplementedError),  # What is encrypted, or packed in a way that Python does not know.
    ) as error:
        raise _refused(path, _reason(error)) from error
    taught = f"{provenance.data_name}, adapted from another model" if provenance.adapted_from else provenance.data_name
    return StoredMethod(learner, model, taught, provenance)


def _reason(error: Exception) -> str:
    told = (isinstance(error, OSError) and error.strerror) or str(error)
    return told.splitlines()[0] if told else type(error).__name__


def _refused(path: Path, why: str) -> FormatError:
    return FormatError(f"{path} is no whole model file: {why}; {_REMEDY}")


def _read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        # numpy.load would take a pickle for a file that is no archive; and its own check of sums comes with reading.
        if (damaged := archive.testzip()) is not None:
            raise ValueError(f"{damaged} is damaged")
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in content.files}


def settings_of(learner: FeatureLearner) -> dict[str, Any]:
    """Return the settings of a learner as JSON has them, by their names."""
    if not dataclasses.is_dataclass(learner):
        raise TypeError(f"{learner.name} is no dataclass, whose fields would be its settings")
    return {each.name: getattr(learner, each.name) for each in dataclasses.fields(learner)}


def _with_settings(learner: FeatureLearner, settings: Mapping[str, Any]) -> FeatureLearner:
    expected = settings_of(learner)
    if set(settings) != set(expected):
        raise ValueError(f"it has the settings {', '.join(sorted(settings))}; expected {', '.join(sorted(expected))}")
    for name, value in settings.items():
        if type(value) is not type(expected[name]):
            raise ValueError(f"the setting {name} is {value!r}, expected one such as {expected[name]!r}")
    return type(learner)(**settings)
