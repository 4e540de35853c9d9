"""What the commands share: options that several have, the data set that they read, and the methods that they name.

The order in which a text is tried as a method: a file that ends in .csv holds estimates, one that ends in .npz is a
model; then a name of `standard_methods` or `standard_learners`; then module:Class or path/file.py:Class.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from foundation.console import option, orderly_end, progress
from foundation.errors import InputError, nearest_names

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


@contextmanager
def image_steps(count: int) -> Generator[Callable[[], None]]:
    """Show how many of `count` images are done, and yield what moves that on by one; Ctrl-C ends the block orderly."""
    with orderly_end(), progress("images") as advance:
        steps = itertools.count(1)
        yield lambda: advance(next(steps), count)


Read = Annotated[
    list[str] | None,
    option(
        "KEY=VALUE",
        "How DATA is read; give it more than once for several. layout=NAME: generated, thumbnails, cube-plus, cube++, "
        "simple-cube++, nus8, gehler-shi, intel-tau, lsmi, ffcc or folder. camera=NAME: one of several. subset=NAME: a "
        "part, such as train or test. truth=NAME: one of several ground truths. black=LEVEL, saturation=LEVEL: in the "
        "units of the files. partial: leave out what a copy lacks. docs/reference/datasets.md has the names. "
        "\\[default: as DATA looks and its layout has it]",
    ),
]


def open_data(place: str, read: Sequence[str] | None = None) -> SceneSet:
    """Return the data set at a place, read as the texts of --read ask."""
    from evaluation.datasets import open_scenes
    from evaluation.datasets.opening import with_black_judged

    layout, options = reading_options(read or ())
    return with_black_judged(open_scenes(place, layout, options), options.black)


def reading_options(texts: Sequence[str]) -> tuple[str | None, DataOptions]:
    """Return the layout and the options that texts of --read ask for.

    Examples
    --------
    >>> layout, options = reading_options(["layout=nus8", "black=128", "partial"])
    >>> layout, options.given
    ('nus8', ('black', 'partial'))
    """
    from evaluation.datasets.options import DataOptions

    keys = ("layout", *(field.name for field in fields(DataOptions)))
    values: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if key not in keys:
            raise InputError(f"--read {text}: {nearest_names(key, keys)} expected one of {', '.join(keys)}")
        if key in values:
            raise InputError(f"--read {text}: {key} is given twice; give it once")
        if (key == "partial") == bool(equals):
            raise InputError(f"--read {text}: expected partial alone, and KEY=VALUE of every other key")
        try:
            values[key] = float(value) if key in ("black", "saturation") else value or True
        except ValueError as error:
            raise InputError(f"--read {text}: expected a number, in the units of the files") from error
    return values.pop("layout", None), DataOptions(**values)


def split_names(texts: Iterable[str]) -> list[str]:
    """Return what texts name between commas, without blanks around it."""
    return [part.strip() for text in texts for part in text.split(",") if part.strip()]


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
    given = [text.strip() for text in texts]
    twice = next((text for number, text in enumerate(given) if text in given[:number]), None)
    if twice is not None:
        raise InputError(f"the method {twice} is named twice; name it once")
    return given


def choose_beside_constant(texts: Sequence[str]) -> tuple[list[Learner], list[str]]:
    """Return the learners that texts name, and why some of `all` are left out.

    The constant light is not among them: it stands beside all others unasked.
    """
    from evaluation.learning.constant_light import ConstantLight
    from evaluation.learning.feature_learner import what_is_missing

    explicit = {learner.name for learner in choose_learners(part for part in texts if part.lower() != "all")}
    named = [learner for learner in choose_learners(texts) if learner.name != ConstantLight().name]
    missing = {learner.name: what_is_missing(learner) for learner in named if learner.name not in explicit}
    left_out = [f"{name} is left out: {reason}" for name, reason in missing.items() if reason]
    return [learner for learner in named if not missing.get(learner.name)], left_out


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


def is_learner(text: str) -> bool:
    """Return whether a text names something that learns: a name of `standard_learners`, or a class that has fit."""
    from evaluation.learning.standard import standard_learners
    from evaluation.methods.standard import standard_methods

    if text in standard_learners():
        return True
    return text.lower() not in ("standard", *standard_methods()) and callable(getattr(_found(text), "fit", None))


def _found(text: str) -> Method | Learner:
    from evaluation.learning.model_files import load_model
    from evaluation.methods.naming import find_method

    return load_model(Path(text)) if text.endswith(".npz") else find_method(text)
