"""What the commands share: options that several have, the data set that they read, and the methods that they name.

A command has one parameter `reading: DataReading`, and `@grouped` puts the options in its place::

    @grouped
    def run(dataset: Annotated[str, typer.Argument()], *, reading: DataReading) -> None:
        data = reading.open(dataset)

The order in which a text is tried as a method: a file that ends in .npz is a model; a name of `standard_methods` or
`standard_learners`; then module:Class or path/file.py:Class.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from foundation.console import option

if TYPE_CHECKING:
    from evaluation.datasets.options import DataOptions
    from evaluation.methods.method import Learner, Method
    from evaluation.results.files import GivenEstimates
    from evaluation.scene import SceneSet


def argument(metavar: str, text: str) -> Any:
    """Return a typer argument."""
    return typer.Argument(metavar=metavar, help=text, show_default=False)


def thread_option(text: str = "") -> Any:
    """Return the option --workers; `text` is what else its help says of the threads."""
    return option("N", f"Threads{text}. \\[default: one a processor]", min=1)


Data = Annotated[str, argument("DATA", "Folder or file of the data set, or its URL.")]

AngularError = Literal["reproduction", "recovery"]

PrintedError = Annotated[
    AngularError, typer.Option(help="Angular error that is printed, and drawn in the report; files have both.")
]

PrintedStatistics = Annotated[
    Literal["paper", "all"],
    typer.Option(help="Print the paper's six statistics, or also 95th percentile, maximum and share below 3°."),
]


@contextmanager
def image_steps(count: int) -> Generator[Callable[[], None]]:
    """Show how many of `count` images are done, and yield what moves that on by one; Ctrl-C ends the block orderly."""
    from foundation.console import orderly_end, progress

    with orderly_end(), progress("images") as advance:
        steps = itertools.count(1)
        yield lambda: advance(next(steps), count)


_reading_option = partial(option, panel="Reading the data")


@dataclass(frozen=True)
class DataReading:
    """How the data sets that a command is given are read; see `evaluation.datasets.options.DataOptions`.

    - `layout`: A name of `evaluation.datasets.LAYOUTS`; None takes the one that a place looks like.
    - `camera`, `subset`, `truth`: of a data set that has several.
    - `black`, `saturation`: levels that replace those of the layout, in the units of the files.
    - `partial`: whether missing images are left out and counted.
    """

    layout: Annotated[
        str | None,
        _reading_option(
            "NAME",
            "Layout of the data set: generated, thumbnails, cube-plus, cube++, simple-cube++, nus8, gehler-shi, "
            "intel-tau, lsmi, ffcc or folder. \\[default: what it looks like]",
        ),
    ] = None
    camera: Annotated[
        str | None,
        _reading_option("NAME", "One camera of nus8, gehler-shi (1D, 5D), intel-tau or lsmi. \\[default: all]"),
    ] = None
    subset: Annotated[
        str | None,
        _reading_option(
            "NAME",
            "Part of the data set: train, validation or test of generated or (train, test) of simple-cube++; "
            "lab_printouts … of intel-tau; train, val, test, single, mixed or test-mixed … of lsmi. \\[default: all]",
        ),
    ] = None
    truth: Annotated[
        str | None,
        _reading_option(
            "NAME",
            "Ground truth where there are several: mean, left, right, left-white or right-white of cube++; own, left "
            "or right of cube-plus; recommended or shi of gehler-shi. \\[default: the first of these]",
        ),
    ] = None
    black: Annotated[
        float | None, _reading_option("LEVEL", "Black level, in the units of the files. \\[default: the layout's]")
    ] = None
    saturation: Annotated[
        float | None,
        _reading_option(
            "LEVEL",
            "Value from which a pixel is clipped, in the units of the files. \\[default: the layout's]",
        ),
    ] = None
    partial: Annotated[
        bool,
        _reading_option(
            None, "Take what is there of a copy that lacks images, and say how many it lacks.", "--partial"
        ),
    ] = False

    def open(self, place: str) -> SceneSet:
        """Return the data set at a place; see `evaluation.datasets.opening.open_scenes`."""
        from evaluation.datasets import open_scenes
        from evaluation.datasets.opening import with_black_judged

        return with_black_judged(open_scenes(place, self.layout, self.options), self.black)

    @property
    def options(self) -> DataOptions:
        """The options without the layout."""
        from evaluation.datasets.options import DataOptions

        return DataOptions(self.camera, self.subset, self.truth, self.black, self.saturation, self.partial)


METHOD_HELP = (
    "Method: a name of --methods, also with parameters (shades-of-gray:p=4, gray-edge-1:p=4:sigma=2), a model file "
    "(MODEL.npz of evaluate train), module:Class, or file.py:Class for a class of your own. Give it more than once for "
    "several."
)
"""Help of the option --method."""


def choose_methods(texts: Iterable[str]) -> list[Method]:
    """Return the methods that texts name, each once, in their order.

    `standard` are the seven of `STANDARD`, `all` every one of `standard_methods`; what stands beside them and is one of
    them comes once, but a text that is given twice is refused.

    Examples
    --------
    >>> [method.name for method in choose_methods(["white-patch", "gray-world"])]
    ['White-Patch', 'Gray-world']
    >>> len(choose_methods(["standard", "gray-world"]))
    7
    >>> choose_methods(["gray-world", "gray-world"])
    Traceback (most recent call last):
        ...
    foundation.errors.InputError: the method gray-world is named twice; name it once
    """
    from evaluation.methods.standard import STANDARD, standard_methods

    groups = {"standard": STANDARD, "all": tuple(standard_methods())}
    wanted: list[str] = []
    for text in _each_once(texts):
        wanted += groups.get(text.lower(), (text,))
    return [_method(text) for text in dict.fromkeys(wanted)]


def choose_learners(texts: Iterable[str]) -> list[Learner]:
    """Return the learners that texts name, each once, in their order; `all` are those of `standard_learners`.

    Examples
    --------
    >>> [learner.name for learner in choose_learners(["regression-trees"])]
    ['Regression trees (simple features)']
    """
    from evaluation.learning.standard import standard_learners

    wanted: list[str] = []
    for text in _each_once(texts):
        wanted += standard_learners() if text.lower() == "all" else [text]
    return [_learner(text) for text in dict.fromkeys(wanted)]


def _each_once(texts: Iterable[str]) -> list[str]:
    """Return texts without blanks around them; one that comes twice is refused."""
    from foundation.errors import InputError

    given = [text.strip() for text in texts]
    twice = next((text for number, text in enumerate(given) if text in given[:number]), None)
    if twice is not None:
        raise InputError(f"the method {twice} is named twice; name it once")
    return given


def choose_beside_constant(text: str) -> tuple[list[Learner], list[str]]:
    """Return the learners that a text names between commas, and why some of `all` are left out.

    The constant light is not among them: it stands beside all others unasked.
    """
    from evaluation.learning.constant_light import ConstantLight
    from evaluation.learning.feature_learner import what_is_missing

    texts = [part.strip() for part in text.split(",")]
    explicit = {learner.name for learner in choose_learners(part for part in texts if part.lower() != "all")}
    named = [learner for learner in choose_learners(texts) if learner.name != ConstantLight().name]
    missing = {learner.name: what_is_missing(learner) for learner in named if learner.name not in explicit}
    left_out = [f"{name} is left out: {reason}" for name, reason in missing.items() if reason]
    return [learner for learner in named if not missing.get(learner.name)], left_out


def require_order(command: str, method: str, data: str) -> None:
    """Refuse METHOD and DATA of `evaluate cv` and `evaluate train` in the wrong order.

    Examples
    --------
    >>> require_order("cv", ".", "regression-trees")
    Traceback (most recent call last):
        ...
    foundation.errors.InputError: . is a data set and regression-trees a method: the method comes first: evaluate cv \
regression-trees .
    """
    from evaluation.learning.standard import standard_learners
    from foundation.errors import InputError

    names = {*standard_learners(), "all"}
    is_method = all(part.strip() in names or ".py:" in part for part in data.split(","))
    if is_method and not Path(data).exists() and (Path(method).exists() or "://" in method):
        raise InputError(
            f"{method} is a data set and {data} a method: the method comes first: evaluate {command} {data} {method}"
        )


def choose_estimates(texts: Sequence[str], images: Sequence[str]) -> list[GivenEstimates]:
    """Return the files of estimates that texts name, as FILE.csv or NAME=FILE.csv, for the images of a data set."""
    from evaluation.results.files import read_estimates

    found: list[GivenEstimates] = []
    for text in texts:
        name, equals, path = text.partition("=")
        named = bool(equals) and bool(name) and not Path(text).exists()
        found.append(read_estimates(Path(path if named else text), images, name if named else None))
    return found


def _method(text: str) -> Method:
    from evaluation.learning.standard import standard_learners
    from foundation.errors import InputError

    if text in standard_learners():
        raise InputError(
            f"{text} learns from images first: evaluate train {text} DATA --out MODEL.npz makes a method of it, and "
            f"evaluate cv {text} DATA cross-validates it"
        )
    found = _found(text)
    if not callable(getattr(found, "estimate", None)):
        raise InputError(f"{text} has no estimate(image, saturation, mask): it learns first: give it to evaluate cv")
    return cast("Method", found)


def _learner(text: str) -> Learner:
    from evaluation.learning.standard import standard_learners
    from evaluation.methods.standard import standard_methods
    from foundation.errors import InputError, nearest_names

    known = standard_learners()
    if text in known:
        return known[text]
    expected = f"expected {', '.join(known)}, module:Class or file.py:Class"
    if text in standard_methods() or text.endswith(".npz"):
        raise InputError(f"{text} has nothing to learn; {expected}")
    if ":" not in text:
        near = nearest_names(text, known)
        raise InputError(f"{text!r} is no method that learns; {f'{near} ' if near else ''}{expected}")
    found = _found(text)
    if not callable(getattr(found, "fit", None)):
        raise InputError(f"{text} has no fit(scenes, seed); evaluate run takes methods that need not learn")
    return cast("Learner", found)


def _found(text: str) -> Method | Learner:
    from evaluation.learning.model_files import load_model
    from evaluation.methods.naming import find_method

    return load_model(Path(text)) if text.endswith(".npz") else find_method(text)
