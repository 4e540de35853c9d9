"""Run methods on the scenes of a data set: each image is decoded once, whatever the number of methods.

What a method may do wrong is dealt with here. A value that is no light (None, a channel that is NaN, infinite or below
0, or nothing but zeros) is no estimate for that image: it is counted and named, and grey stands in for it, so that a
method gains nothing by leaving out what it finds hard. An exception, or a value that is not three numbers, ends the
run with the name of the method and the image, and the line of the method's file.
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
from evaluation.results.result import Result, SceneAnswer, read_light, results_of
from evaluation.scene import MixedScene, Scene, told_of
from foundation.compiled import ordered_map
from foundation.errors import CropError, FormatError, InputError

# This package's folder: what lies outside of it, and is no installed library, is the user's.
_HOUSE = Path(__file__).parents[1]


@runtime_checkable
class SceneMethod(Protocol):
    """What knows a scene's light without its pixels, such as estimates that another program has made."""

    @property
    def name(self) -> str:
        """Its name in tables."""
        ...

    def estimate_scene(self, scene: Scene) -> npt.NDArray[np.float64] | None:
        """Return the estimated light (3,) float64 of a scene, camera RGB of any length; None if there is none."""
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
    Any value with a name, a ground truth, a saturation and `read` is a scene. Gray-world is right on an image that is
    grey on average under its light:

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
    answers = list(told_of(answer_scenes(scenes, methods, workers), on_scene))
    return results_of([method.name for method in methods], truths, answers)


def require_truths(scenes: Sequence[Scene], methods: Sequence[object]) -> npt.NDArray[np.float64]:
    """Return the ground truths (N, 3) float64 of scenes, camera RGB of any length."""
    if not scenes or not methods:
        raise InputError(f"{len(methods)} methods on {len(scenes)} images: name at least one of each")
    return np.stack([_light(scene) for scene in scenes])


def answer_scenes(
    scenes: Sequence[Scene], methods: Sequence[Method | SceneMethod], workers: int = 1
) -> Iterator[tuple[SceneAnswer, ...]]:
    """Yield what the methods answer for each scene, one answer a method, in the scenes' order.

    Methods of this suite are called by several threads at once. Others are called by one thread at a time and get a
    copy of the image, which they may change; with one worker everything runs in the calling thread.
    """
    runners = [
        _Runner(method, None if type(method).__module__.startswith("evaluation.") else Lock()) for method in methods
    ]
    blind = all(isinstance(method, SceneMethod) for method in methods)
    yield from ordered_map(lambda scene: _answer(scene, runners, blind), scenes, workers)


@dataclass(frozen=True)
class _Runner:
    """A method, and how it is called: `lock` where it is one of the user's."""

    method: Method | SceneMethod
    lock: Any | None

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the method; a method of the user's one at a time, with its own copies of arrays."""
        if self.lock is None:
            return function(*arguments)
        with self.lock:
            return function(*(one.copy() if isinstance(one, np.ndarray) else one for one in arguments))


def _answer(scene: Scene, runners: Sequence[_Runner], blind: bool) -> tuple[SceneAnswer, ...]:
    """Return the answers for one scene; its image is left unread where no method wants it and one light falls on it."""
    mixed = isinstance(scene, MixedScene)
    image, mask = (None, None) if blind and not mixed else scene.read()
    truth = (scene.read_truth_map(), scene.read_weights()) if isinstance(scene, MixedScene) else None
    prepared = None if image is None else PreparedImage(image, scene.saturation, mask)
    answers: list[SceneAnswer] = []
    for runner in runners:
        method = runner.method
        try:
            if isinstance(method, SceneMethod):
                answer = read_light(runner.call(method.estimate_scene, scene))
            elif runner.lock is None and prepared is not None and isinstance(method, PreparedMethod):
                answer = read_light(method.estimate_prepared(prepared))
            else:
                answer = read_light(runner.call(method.estimate, image, scene.saturation, mask))
            field = None
            if mixed and isinstance(method, LocalMethod):
                field, cause = _field(runner.call(method.estimate_map, image, scene.saturation, mask), image)
                answer = SceneAnswer(answer.light, answer.cause or cause)
        except CropError:
            raise
        except (Exception, SystemExit) as error:
            if runner.lock is None:
                error.add_note(f"while {method.name} was on {scene.name}")
                raise
            raise InputError(f"{method.name} fails on {scene.name}: {_reason(error)}; {_remedy(method)}") from error
        if truth is not None and isinstance(scene, MixedScene) and image is not None:
            answer = SceneAnswer(answer.light, answer.cause, _map_error(scene, answer, field, truth, image, mask))
        answers.append(answer)
    return tuple(answers)


def fit_anew(learner: Learner, scenes: Sequence[Scene], seed: int) -> Method:
    """Return the method that a copy of a learner has learned from scenes.

    The learner itself stays as it is: one that keeps in itself what it learns would take it along from fold to fold,
    and with it the images that it is tested on.
    """
    try:
        fresh = copy.deepcopy(learner)
    except Exception as error:
        raise InputError(
            f"{learner.name} cannot be copied ({error}), so that it would begin each training with what it learned in "
            "the one before; let its constructor keep plain values, and open files and models in fit"
        ) from error
    try:
        method = fresh.fit(scenes, seed)
    except CropError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(
            f"{learner.name} fails to learn from {len(scenes)} images: {_reason(error)}; correct it and run again"
        ) from error
    if not callable(getattr(method, "estimate", None)):
        raise InputError(
            f"{learner.name} returns {type(method).__name__} from fit, expected a method with estimate(image, "
            "saturation, mask); a class that keeps what it has learned in itself returns itself"
        )
    return method


def _field(given: object, image: Any) -> tuple[npt.NDArray[np.floating[Any]], str]:
    """Return a map of lights (H, W, 3) float, grey where a pixel has none, and in words how many those are."""
    field = np.asarray(given)
    if field.shape != image.shape or not np.issubdtype(field.dtype, np.floating):
        raise ValueError(
            f"estimate_map returned {field.dtype} of shape {field.shape}, expected floats {tuple(image.shape)}"
        )
    bad = np.asarray(~(np.isfinite(field).all(axis=2) & (field >= 0).all(axis=2) & field.any(axis=2)))
    if not bad.any():
        return field, ""
    return np.where(bad[..., None], GREY, field), f"no light in {int(bad.sum())} of {bad.size} pixels of its map"


def _map_error(
    scene: MixedScene,
    answer: SceneAnswer,
    field: npt.NDArray[np.floating[Any]] | None,
    truth: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]],
    image: npt.NDArray[Any],
    mask: npt.NDArray[np.bool_] | None,
) -> MapError:
    lights, weights = truth
    if lights.shape != image.shape or weights.shape[:2] != image.shape[:2]:
        raise FormatError(
            f"{scene.name} is {image.shape[1]}x{image.shape[0]} px, its map of lights {lights.shape[1]}x"
            f"{lights.shape[0]}, its shares {weights.shape[1]}x{weights.shape[0]}; expected the same size of each"
        )
    estimate = field if field is not None else np.array(GREY if answer.light is None else answer.light)
    return measure_map(estimate, lights, weights, scene.lights, image, scene.saturation, mask)


def _reason(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    foreign = [frame for frame in frames if _HOUSE not in Path(frame.filename).parents]
    own = [frame for frame in foreign if "site-packages" not in Path(frame.filename).parts] or foreign
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    name = type(error).__name__
    return f"{error}{place}" if isinstance(error, ValueError) and not own else f"{name}: {error}{place}"


def _remedy(method: object) -> str:
    """Return what to do about a method that fails; one that has `fit` lacks, more often than not, what that learns."""
    if callable(getattr(method, "fit", None)):
        return "it has fit: if it learns first, give it to evaluate cv, which trains it; else correct it and run again"
    return "correct it and run again"


def _light(scene: Scene) -> npt.NDArray[np.float64]:
    truth = scene.truth
    if not (np.isfinite(truth).all() and truth.min() >= 0 and truth.any()):
        raise InputError(
            f"the ground truth of {scene.name} is {' '.join(f'{part:g}' for part in truth)}, expected red, green and "
            "blue of a light: none below 0, not all 0; correct it"
        )
    return truth
