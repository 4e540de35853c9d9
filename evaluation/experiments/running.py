"""Run methods on the scenes of a data set; each image is decoded once for all methods.

A method has no estimate for an image if it returns None, or values that are negative, NaN, infinite or all 0. Such
images are counted and listed, and grey is used as the estimate. An exception, or a value that is not three numbers,
ends the run. The message names the method, the image, and the line in the user's file.
"""

from __future__ import annotations

import copy
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Learner, LocalMethod, Method
from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod
from evaluation.metrics import MapError, measure_map
from evaluation.results.result import Result, SceneAnswer, collect_results, read_estimate
from evaluation.scene import MixedScene, Scene, report_progress
from foundation.compiled import ordered_map
from foundation.errors import RUN_AGAIN, CropError, FormatError, InputError

# Folder of this package. Code outside this folder belongs to the user or to an installed library.
_PACKAGE_FOLDER = Path(__file__).parents[1]


@runtime_checkable
class SceneMethod(Protocol):
    """Source of estimates that needs no pixels, such as a file from another program."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    def estimate_scene(self, scene: Scene) -> npt.NDArray[np.float64] | None:
        """Return the estimate (3,) float64 for a scene, camera RGB of any scale; None without an estimate."""
        ...


def evaluate(
    scenes: Sequence[Scene],
    methods: Sequence[Method | SceneMethod],
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[Result, ...]:
    """Return the estimates and errors of every method on every scene; each image is read once.

    Examples
    --------
    Any object with a name, a ground truth, a saturation and `read` is a scene. Gray-world is exact on an image that is
    grey on average under its illuminant:

    >>> from evaluation.methods.standard import standard_methods
    >>> class Wall:
    ...     name, truth, saturation = "wall", np.array([1.0, 2.0, 1.0]), None
    ...
    ...     def read(self):
    ...         return np.ones((8, 8, 3)) * [500, 1000, 500], None
    >>> (result,) = evaluate([Wall()], [standard_methods()["gray-world"]])
    >>> f"{result.method}: {result.summary('reproduction').mean:.2f} degrees"
    'Gray-world: 0.00 degrees'
    """
    truths = require_truths(scenes, methods)
    answers = list(report_progress(answer_scenes(scenes, methods, workers), on_scene))
    return collect_results([method.name for method in methods], truths, answers)


def require_truths(scenes: Sequence[Scene], methods: Sequence[object]) -> npt.NDArray[np.float64]:
    """Return the ground truths (N, 3) float64 of scenes, camera RGB of any scale. Invalid ones raise InputError."""
    if not scenes or not methods:
        raise InputError(f"{len(methods)} methods on {len(scenes)} images, expected at least one of each; give some")
    return np.stack([_checked_truth(scene) for scene in scenes])


def answer_scenes(
    scenes: Sequence[Scene], methods: Sequence[Method | SceneMethod], workers: int = 1
) -> Iterator[tuple[SceneAnswer, ...]]:
    """Yield the answers of all methods for each scene, in the order of the scenes.

    Methods of this suite run in several threads at once. A method of the user runs in one thread at a time and
    receives copies of the image, which it may change; with one worker it runs in the calling thread.
    """
    calls = [
        _MethodCall(method, None if type(method).__module__.startswith("evaluation.") else Lock()) for method in methods
    ]
    needs_no_image = all(isinstance(method, SceneMethod) for method in methods)
    yield from ordered_map(lambda scene: _answer(scene, calls, needs_no_image), scenes, workers)


@dataclass(frozen=True)
class _MethodCall:
    """A method, with a lock if it is the user's."""

    method: Method | SceneMethod
    lock: Any | None

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        if self.lock is None:
            return function(*arguments)
        with self.lock:
            return function(*(item.copy() if isinstance(item, np.ndarray) else item for item in arguments))


def _answer(scene: Scene, calls: Sequence[_MethodCall], needs_no_image: bool) -> tuple[SceneAnswer, ...]:
    # An image is not read if no method needs its pixels and it has only one illuminant.
    is_mixed = isinstance(scene, MixedScene)
    image, mask = (None, None) if needs_no_image and not is_mixed else scene.read()
    truth = (scene.read_truth_map(), scene.read_weights()) if isinstance(scene, MixedScene) else None
    prepared = None if image is None else PreparedImage(image, scene.saturation, mask)
    answers: list[SceneAnswer] = []
    for runner in calls:
        method = runner.method
        try:
            if isinstance(method, SceneMethod):
                answer = read_estimate(runner.call(method.estimate_scene, scene))
            elif runner.lock is None and prepared is not None and isinstance(method, PreparedMethod):
                answer = read_estimate(method.estimate_prepared(prepared))
            else:
                answer = read_estimate(runner.call(method.estimate, image, scene.saturation, mask))
            local_map = None
            if is_mixed and isinstance(method, LocalMethod):
                local_map, cause = _checked_map(runner.call(method.estimate_map, image, scene.saturation, mask), image)
                answer = SceneAnswer(answer.light, answer.cause or cause)
        except CropError:
            raise
        except (Exception, SystemExit) as error:
            if runner.lock is None:
                error.add_note(f"method {method.name}, image {scene.name}")
                raise
            raise InputError(f"{method.name} failed on {scene.name}: {_reason(error)}; {_remedy(method)}") from error
        if truth is not None and isinstance(scene, MixedScene) and image is not None:
            answer = SceneAnswer(answer.light, answer.cause, _map_error(scene, answer, local_map, truth, image, mask))
        answers.append(answer)
    return tuple(answers)


def fit_copy(learner: Learner, scenes: Sequence[Scene], seed: int) -> Method:
    """Fit a copy of the learner to scenes, and return the fitted method.

    A learner may store its training data. Without the copy, test images of later folds would be among these data.
    """
    try:
        fresh = copy.deepcopy(learner)
    except Exception as error:
        raise InputError(
            f"{learner.name} cannot be copied ({error}), expected a constructor that stores plain values only, so that "
            "each training starts from the same state; open files and models in fit"
        ) from error
    try:
        method = fresh.fit(scenes, seed)
    except CropError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(
            f"{learner.name} failed in training on {len(scenes)} images: {_reason(error)}; correct it, {RUN_AGAIN}"
        ) from error
    if not callable(getattr(method, "estimate", None)):
        raise InputError(
            f"{learner.name}.fit returned {type(method).__name__}, expected a method with estimate(image, saturation, "
            "mask); return self if the class itself is the fitted method"
        )
    return method


def _checked_map(returned_value: object, image: Any) -> tuple[npt.NDArray[np.floating[Any]], str]:
    """Return the estimates (H, W, 3) float with grey for missing ones, and a note on their number or ""."""
    estimates = np.asarray(returned_value)
    if estimates.shape != image.shape or not np.issubdtype(estimates.dtype, np.floating):
        raise ValueError(
            f"estimate_map returned {estimates.dtype} of shape {estimates.shape}, expected floats {tuple(image.shape)}"
        )
    is_missing = np.asarray(
        ~(np.isfinite(estimates).all(axis=2) & (estimates >= 0).all(axis=2) & estimates.any(axis=2))
    )
    if not is_missing.any():
        return estimates, ""
    note = f"no estimate in {int(is_missing.sum())} of {is_missing.size} pixels of its map"
    return np.where(is_missing[..., None], GREY, estimates), note


def _map_error(
    scene: MixedScene,
    answer: SceneAnswer,
    estimate_map: npt.NDArray[np.floating[Any]] | None,
    truth: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]],
    image: npt.NDArray[Any],
    mask: npt.NDArray[np.bool_] | None,
) -> MapError:
    truths, weights = truth
    if truths.shape != image.shape or weights.shape[:2] != image.shape[:2]:
        raise FormatError(
            f"{scene.name} is {image.shape[1]}x{image.shape[0]} px, its map of illuminants {truths.shape[1]}x"
            f"{truths.shape[0]}, its weights {weights.shape[1]}x{weights.shape[0]}, expected the same size; correct it"
        )
    estimate = estimate_map if estimate_map is not None else np.array(GREY if answer.light is None else answer.light)
    return measure_map(estimate, truths, weights, scene.lights, image, scene.saturation, mask)


def _reason(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    outside = [frame for frame in frames if _PACKAGE_FOLDER not in Path(frame.filename).parents]
    user_frames = [frame for frame in outside if "site-packages" not in Path(frame.filename).parts] or outside
    line_text = f" ({Path(user_frames[-1].filename).name}, line {user_frames[-1].lineno})" if user_frames else ""
    # A ValueError from a check of this package has a complete message, so its type is not shown.
    is_complete = isinstance(error, ValueError) and not user_frames
    return f"{error}{line_text}" if is_complete else f"{type(error).__name__}: {error}{line_text}"


def _remedy(method: object) -> str:
    if callable(getattr(method, "fit", None)):
        # A class with `fit` usually fails here because it was not trained.
        return f"if it must be trained first, use evaluate cv, otherwise correct it, {RUN_AGAIN}"
    return f"correct it, {RUN_AGAIN}"


def _checked_truth(scene: Scene) -> npt.NDArray[np.float64]:
    truth = scene.truth
    if not (np.isfinite(truth).all() and truth.min() >= 0 and truth.any()):
        raise InputError(
            f"the ground truth of {scene.name} is {' '.join(f'{channel:g}' for channel in truth)}, expected red, green "
            "and blue of an illuminant, all ≥ 0 and not all 0; correct it"
        )
    return truth
