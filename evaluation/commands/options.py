"""Options, data sets and methods shared by the commands.

The text for a method is interpreted in this order: FILE.csv (estimates), FILE.npz (a model), a name of
`standard_methods` or `standard_learners`, module:Class or path/file.py:Class.
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
from foundation.folders import require_free

if TYPE_CHECKING:
    from evaluation.datasets.options import DataOptions
    from evaluation.methods.method import Learner, Method
    from evaluation.results.files import GivenEstimates
    from evaluation.scene import SceneSet


def argument(metavar: str, text: str) -> Any:
    """Return a typer argument without a default in its help."""
    return typer.Argument(metavar=metavar, help=text, show_default=False)


def thread_option(text: str = "") -> Any:
    """Return the option --workers; `text` is added to its help."""
    return option("N", f"Threads{text}. \\[default: one per processor]", min=1)


# Arguments and options that several commands share.
Data = Annotated[str, argument("DATA", "Folder, file or URL of the data set.")]

AngularError = Literal["reproduction", "recovery"]

PrintedError = Annotated[
    AngularError, typer.Option(help="Angular error that is printed, and drawn in the report; files contain both.")
]


Figures = Annotated[
    Literal["pdf", "svg"] | None,
    typer.Option(help="Also write the figures for a paper to the results folder.", show_default=False),
]


def require_results_folder(out: Path | None, content: str, figures: str | None) -> None:
    """Raise InputError if the results folder exists, or if it is missing and figures are requested."""
    if out is not None:
        require_free(out, content)
    elif figures is not None:
        raise InputError(f"--figures {figures} is given without --out, expected a results folder; add --out FOLDER")


@contextmanager
def image_steps(count: int) -> Generator[Callable[[], None]]:
    """Show the progress of `count` images; yield a function that counts one image."""
    with orderly_end(), progress("images") as advance:
        steps = itertools.count(1)
        yield lambda: advance(next(steps), count)


Read = Annotated[
    list[str] | None,
    option(
        "KEY=VALUE",
        "How DATA is read; repeat the option for several keys. layout=NAME: generated, thumbnails, cube-plus, cube++, "
        "simple-cube++, nus8, gehler-shi, intel-tau, lsmi, levi, ffcc or folder. camera=NAME: one of several. "
        "subset=NAME: a part, such as train or test. truth=NAME: one of several ground truths. black=LEVEL, "
        "saturation=LEVEL: in the units of the files. partial: skip images missing in a copy. "
        "docs/reference/datasets.md lists the names. "
        "\\[default: detected layout, with its own values]",
    ),
]


def open_data(location: str, read: Sequence[str] | None = None) -> SceneSet:
    """Return the data set, read with the values of --read."""
    from evaluation.datasets import open_scenes
    from evaluation.datasets.opening import check_black_level

    layout, options = reading_options(read or ())
    return check_black_level(open_scenes(location, layout, options), options.black)


def reading_options(texts: Sequence[str]) -> tuple[str | None, DataOptions]:
    """Return the layout and the options for the values of --read.

    Examples
    --------
    >>> layout, options = reading_options(["layout=nus8", "black=128", "partial"])
    >>> layout, options.set_options
    ('nus8', ('black', 'partial'))
    """
    from evaluation.datasets.options import DataOptions

    keys = ("layout", *(field.name for field in fields(DataOptions)))
    values: dict[str, Any] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if key not in keys:
            suggestion = nearest_names(key, keys)
            raise InputError(f"--read {text}: expected one of {', '.join(keys)}; {suggestion or 'correct it'}")
        if key in values:
            raise InputError(f"--read {text}: {key} is given twice, expected once; omit one")
        if (key == "partial") == bool(separator):
            raise InputError(f"--read {text}: expected partial alone, and KEY=VALUE for all other keys; correct it")
        try:
            values[key] = float(value) if key in ("black", "saturation") else value or True
        except ValueError as error:
            raise InputError(f"--read {text}: expected a number, in the units of the files; correct it") from error
    return values.pop("layout", None), DataOptions(**values)


def split_names(texts: Iterable[str]) -> list[str]:
    """Return all names in the texts; names in one text are separated by commas."""
    return [name.strip() for text in texts for name in text.split(",") if name.strip()]


def choose_methods(texts: Iterable[str]) -> list[Method]:
    """Return the named methods in their order, each once.

    `standard` stands for the methods of `STANDARD`, `all` for all `standard_methods`. A method that is named
    in addition to `standard` or `all` is used once. A name that is given twice is refused.

    Examples
    --------
    >>> [method.name for method in choose_methods(["white-patch", "gray-world"])]
    ['White-Patch', 'Gray-world']
    >>> len(choose_methods(["standard", "gray-world"]))
    7
    >>> choose_methods(["gray-world", "gray-world"])
    Traceback (most recent call last):
        ...
    foundation.errors.InputError: the method gray-world is given twice, expected once; omit one
    """
    from evaluation.methods.standard import STANDARD, standard_methods

    groups = {"standard": STANDARD, "all": tuple(standard_methods())}
    names: list[str] = []
    for text in _distinct_names(texts):
        names += groups.get(text.lower(), (text,))
    return [_load_method(text) for text in dict.fromkeys(names)]


def choose_learners(texts: Iterable[str]) -> list[Learner]:
    """Return the named learners in their order, each once; `all` stands for all `standard_learners`.

    Examples
    --------
    >>> [learner.name for learner in choose_learners(["regression-trees"])]
    ['Regression trees (simple features)']
    """
    from evaluation.learning.standard import standard_learners

    names: list[str] = []
    for text in _distinct_names(texts):
        names += standard_learners() if text.lower() == "all" else [text]
    return [_load_learner(text) for text in dict.fromkeys(names)]


def _distinct_names(texts: Iterable[str]) -> list[str]:
    names = [text.strip() for text in texts]
    repeated = next((text for index, text in enumerate(names) if text in names[:index]), None)
    if repeated is not None:
        raise InputError(f"the method {repeated} is given twice, expected once; omit one")
    return names


def choose_without_constant(texts: Sequence[str]) -> tuple[list[Learner], list[str]]:
    """Return the named learners without the constant illuminant, and notes on omitted learners.

    `all` omits learners that need a library that is not installed. The commands add the constant illuminant.
    """
    from evaluation.learning.constant_light import ConstantLight
    from evaluation.learning.feature_learner import missing_requirement

    explicit = {learner.name for learner in choose_learners(text for text in texts if text.lower() != "all")}
    learners = [learner for learner in choose_learners(texts) if learner.name != ConstantLight().name]
    missing = {learner.name: missing_requirement(learner) for learner in learners if learner.name not in explicit}
    notes = [f"{name} is omitted: {reason}" for name, reason in missing.items() if reason]
    return [learner for learner in learners if not missing.get(learner.name)], notes


def choose_estimates(texts: Sequence[str], images: Sequence[str]) -> list[GivenEstimates]:
    """Return the estimates of the files FILE.csv or NAME=FILE.csv for the images of a data set."""
    from evaluation.results.files import read_estimates

    estimates: list[GivenEstimates] = []
    for text in texts:
        # An existing file whose name contains "=" is not NAME=FILE.
        name, separator, path = text.partition("=")
        has_name = bool(separator) and bool(name) and not Path(text).exists()
        estimates.append(read_estimates(Path(path if has_name else text), images, name if has_name else None))
    return estimates


def _load_method(text: str) -> Method:
    from evaluation.learning.standard import standard_learners

    if text in standard_learners():
        raise InputError(
            f"{text} must be trained first, expected a method with estimate; use evaluate train {text} DATA --out "
            f"MODEL.npz and give MODEL.npz, or cross-validate it with evaluate cv {text} DATA"
        )
    method = _load_named(text)
    if not callable(getattr(method, "estimate", None)):
        raise InputError(
            f"{text} has no method estimate(image, saturation, mask), expected one; train it with evaluate cv"
        )
    return cast("Method", method)


def _load_learner(text: str) -> Learner:
    from evaluation.learning.standard import standard_learners
    from evaluation.methods.standard import standard_methods

    learners = standard_learners()
    if text in learners:
        return learners[text]
    expected = f"expected {', '.join(learners)}, module:Class or file.py:Class"
    if text in standard_methods() or text.endswith(".npz"):
        raise InputError(f"{text} cannot be trained, {expected}; give one of these")
    if ":" not in text:
        suggestion = nearest_names(text, learners)
        raise InputError(f"{text!r} is not a learned method, {expected}; {suggestion or 'give one of these'}")
    learner = _load_named(text)
    if not callable(getattr(learner, "fit", None)):
        raise InputError(f"{text} has no method fit(scenes, seed), expected one; use evaluate run")
    return cast("Learner", learner)


def is_learner(text: str) -> bool:
    """Return whether the text names a learner: a name of `standard_learners`, or a class with `fit`."""
    from evaluation.learning.standard import standard_learners
    from evaluation.methods.standard import standard_methods

    if text in standard_learners():
        return True
    return text.lower() not in ("standard", *standard_methods()) and callable(getattr(_load_named(text), "fit", None))


def _load_named(text: str) -> Method | Learner:
    from evaluation.learning.model_files import load_model
    from evaluation.methods.naming import find_method

    return load_model(Path(text)) if text.endswith(".npz") else find_method(text)
