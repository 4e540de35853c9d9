"""Which methods a command's options name: the suite's own, the user's classes, model files, learners.

The order in which a text is tried: a file that ends in .npz is a model; a name of `standard_methods` or
`standard_learners`; then module:Class or path/file.py:Class.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from evaluation.methods.method import Learner, Method
    from evaluation.results.estimates import GivenEstimates

METHOD_HELP = (
    "Method: a name of --methods, also with parameters (shades-of-gray:p=4, gray-edge-1:p=4:sigma=2), a model file "
    "(MODEL.npz of evaluate train), module:Class, or file.py:Class for a class of your own. Give it more than once for "
    "several."
)
"""Help of the option --method."""


def choose_methods(texts: Iterable[str]) -> list[Method]:
    """Return the methods that texts name, each once, in their order.

    `standard` are the seven of `STANDARD`, `all` every one of `standard_methods`.

    Raises
    ------
    InputError
        A text names no method, or one that has to be trained first.
    FormatError
        A model file is none.

    Examples
    --------
    >>> [method.name for method in choose_methods(["gray-world", "white-patch", "gray-world"])]
    ['Gray-world', 'White-Patch']
    """
    from evaluation.methods.standard import STANDARD, standard_methods

    groups = {"standard": STANDARD, "all": tuple(standard_methods())}
    wanted: list[str] = []
    for text in texts:
        wanted += groups.get(text.strip().lower(), (text.strip(),))
    return [_method(text) for text in dict.fromkeys(wanted)]


def choose_learners(texts: Iterable[str]) -> list[Learner]:
    """Return the learners that texts name, each once, in their order; `all` are those of `standard_learners`.

    Raises
    ------
    InputError
        A text names no learner.

    Examples
    --------
    >>> [learner.name for learner in choose_learners(["regression-trees"])]
    ['Regression trees (simple features)']
    """
    from evaluation.learning.standard import standard_learners

    wanted: list[str] = []
    for text in texts:
        wanted += standard_learners() if text.strip().lower() == "all" else [text.strip()]
    return [_learner(text) for text in dict.fromkeys(wanted)]


def require_order(command: str, method: str, data: str) -> None:
    """Refuse METHOD and DATA of `evaluate cv` and `evaluate train` in the wrong order.

    Raises
    ------
    InputError
        `method` is the place of a data set, and `data` names methods.

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
    """Return the files of estimates that texts name, as FILE.csv or NAME=FILE.csv, for the images of a data set.

    Raises
    ------
    InputError
        A file cannot be read, or is not of these images.
    FormatError
        A file is no table of estimates.
    """
    from evaluation.results.estimates import read_estimates

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
    from foundation.errors import InputError

    known = standard_learners()
    if text in known:
        return known[text]
    expected = f"expected {', '.join(known)}, module:Class or file.py:Class"
    if text in standard_methods() or text.endswith(".npz"):
        raise InputError(f"{text} has nothing to learn; {expected}")
    if ":" not in text:
        raise InputError(f"{text!r} is no method that learns; {expected}")
    found = _found(text)
    if not callable(getattr(found, "fit", None)):
        raise InputError(f"{text} has no fit(scenes, seed); evaluate run takes methods that need not learn")
    return cast("Learner", found)


def _found(text: str) -> Method | Learner:
    from evaluation.learning.model_files import load_model
    from evaluation.methods.naming import find_method

    return load_model(Path(text)) if text.endswith(".npz") else find_method(text)
