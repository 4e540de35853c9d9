"""Find a method by what a user types: a name of this suite, a class of an installed module, or a class in a file.

    gray-edge-1            a method of `standard.standard_methods`
    gray-edge-1:p=4:sigma=2, shades-of-gray:p=6      the same with other parameters, of the Gray-Edge framework
    package.module:Class   a class or value of a module that Python finds, also beside the working folder
    path/file.py:Class     a class or value of a file; what stands beside the file can be imported by it

and any of these with what is done around it:

    gray-edge-2@360        on images shrunk to 360 px along their longer side (`resized.ResizedMethod`)
    gray-world@patches     by 8 patches along the shorter side, for several lights (`patchwise.PatchwiseMethod`)
    gray-world@patches=12  by 12

A class is made without arguments; a value is taken as it is. A file of ten lines is enough::

    import numpy as np

    class Brightest:
        name = "Brightest pixel"

        def estimate(self, image, saturation=None, mask=None):
            usable = np.ones(image.shape[:2], bool) if mask is None else ~mask
            pixels = image[usable].astype(np.float64)
            light = pixels[pixels.sum(axis=1).argmax()]
            return light / np.linalg.norm(light)

Python of the file and the module is run: name only what you trust.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import re
import sys
import traceback
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, cast

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.standard import local_methods, standard_methods
from evaluation.methods.wrapped import PATCHES, PatchwiseMethod, ResizedMethod
from foundation.errors import InputError, nearest_names
from foundation.version import PACKAGES, require_own_packages

if TYPE_CHECKING:
    from evaluation.methods.method import Learner, Method

FAMILIES = ("shades-of-gray", "general-gray-world", "gray-edge-1", "gray-edge-2")  # The methods that take parameters

_MODIFIERS = re.compile(r"(?P<size>[0-9]{1,6})|patches(=(?P<patches>[0-9]{1,6}))?")

# Scale of a Gaussian that a text may ask for, px: no image has structure beyond, and the filter's width is bounded.
LARGEST_SIGMA = 1000

_FORMS = "a name of this suite, module:Class or path/file.py:Class"


def find_method(text: str) -> Method | Learner:
    """Return the method or learner that a text names.

    Examples
    --------
    >>> find_method("gray-world").name
    'Gray-world'
    >>> find_method("evaluation.methods.pca:BrightDark").name
    'PCA bright and dark'
    >>> find_method("gray-edge-2@360").name
    '2nd-order Gray-Edge at 360 px'
    >>> find_method("gray-edge-1:p=4:sigma=2").name
    '1st-order Gray-Edge (p=4, σ=2)'
    >>> find_method("gray-world@patches=4").name
    'Gray-world by patches'
    """
    wanted = text.strip()
    inner, at, around = wanted.rpartition("@")
    changed = _MODIFIERS.fullmatch(around) if at else None
    if changed is not None:
        method = find_method(inner)
        if not callable(getattr(method, "estimate", None)):
            raise InputError(f"{inner} is fitted first, so there is no {wanted}; train it, and give its model instead")
        number = int(changed["size"] or changed["patches"] or PATCHES)
        if not number:
            raise InputError(f"{wanted}: expected a number above 0 after @")
        if changed["size"]:
            return ResizedMethod(cast("Method", method), number)
        return PatchwiseMethod(cast("Method", method), number)
    family, colon, given = wanted.partition(":")
    if colon and family in standard_methods():
        return _with_parameters(family, given)
    place, colon, name = wanted.rpartition(":")
    if not colon:
        known = {**standard_methods(), **local_methods()}
        if wanted in known:
            return known[wanted]
        near = nearest_names(wanted, known) or f"the methods are {', '.join(known)}"
        raise InputError(f"{wanted!r} is no method; {near}; module:Class or a file names one of your own")
    if not place or not name:
        raise InputError(f"{wanted!r} names no method; expected {_FORMS}")
    is_file = place.endswith(".py")
    module = _module_of_file(Path(place)) if is_file else _module_by_name(place)
    found = getattr(module, name, None)
    if found is None and place in PACKAGES and Path(f"{place}.py").is_file():
        raise InputError(
            f"{wanted}: {place} is a package of this suite, which has no {name!r}; for the file of that name write "
            f"{place}.py:{name}"
        )
    if found is None:
        others = ", ".join(sorted(one for one in vars(module) if _looks_like_method(module, one))) or "none"
        raise InputError(f"{place} has no {name!r}; its classes with estimate or fit: {others}")
    if isinstance(found, type):
        try:
            found = cast("object", found())
        except (Exception, SystemExit) as error:
            raise InputError(
                f"{wanted} cannot be made without arguments: {_fault(error)}; give its parameters defaults, or name a "
                "value of the file instead of the class"
            ) from error
    return checked_method(found, wanted)


def _with_parameters(family: str, given: str) -> Method:
    """Return a method of the Gray-Edge framework with the parameters of a text: "p=4:sigma=2", in either order."""
    standard = standard_methods()[family]
    if family not in FAMILIES or not isinstance(standard, GrayEdge):
        raise InputError(f"{family} takes no parameters; those that do are {', '.join(FAMILIES)}")
    known = ("p", "sigma") if standard.sigma else ("p",)
    values: dict[str, float] = {}
    for part in given.split(":"):
        name, _, text = part.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if name not in known or name in values or math.isnan(value):
            expected = " and ".join(f"{name}=NUMBER" for name in known)
            raise InputError(f"{family}:{given}: {part!r} is no parameter, expected {expected}, once each, between :")
        values[name] = value
    p, sigma = values.get("p", standard.p), values.get("sigma", standard.sigma)
    if p < 1 or sigma > LARGEST_SIGMA or (standard.sigma and sigma <= 0):
        raise InputError(
            f"{family}:{given}: p {p:g} and sigma {sigma:g} make no method, expected p from 1 and sigma above 0, up to "
            f"{LARGEST_SIGMA} px"
        )
    title = standard.name.partition(" (")[0]
    scale = f", σ={sigma:g}" if standard.sigma else ""
    return GrayEdge(f"{title} (p={p:g}{scale})", standard.order, p, sigma)


def checked_method(found: object, place: str) -> Method | Learner:
    """Return an object that is a method or a learner.

    Examples
    --------
    >>> class Nameless:
    ...     def estimate(self, image, saturation=None, mask=None):
    ...         return image.mean(axis=(0, 1))
    >>> checked_method(Nameless(), "own.py:Nameless")
    Traceback (most recent call last):
        ...
    foundation.errors.InputError: own.py:Nameless has no name; add name = "…", the text that stands in the tables
    """
    if not callable(getattr(found, "estimate", None)) and not callable(getattr(found, "fit", None)):
        if callable(getattr(found, "estimate_map", None)):
            raise InputError(
                f"{place} has estimate_map alone; add estimate(image, saturation, mask) beside it, the light of the "
                "whole image, by which it is measured on images under one light"
            )
        raise InputError(
            f"{place} is no method: it has neither estimate(image, saturation, mask) nor fit(scenes, seed); add the "
            "one that it is to have, see docs/how-to/evaluate.md"
        )
    try:
        name = getattr(found, "name", None)
    except Exception as error:
        raise InputError(f"the name of {place} fails: {_fault(error)}; correct it") from error
    if not isinstance(name, str) or not name:
        raise InputError(f'{place} has no name; add name = "…", the text that stands in the tables')
    return cast("Method | Learner", found)


def _looks_like_method(module: ModuleType, name: str) -> bool:
    one = getattr(module, name)
    return not name.startswith("_") and (hasattr(one, "estimate") or hasattr(one, "fit"))


def _module_of_file(path: Path) -> ModuleType:
    """Return the module of a Python file, run once a process: a second method of the file finds the same module."""
    if not path.is_file():
        raise InputError(f"{path} is not there; expected a Python file with the class of a method")
    whole = path.resolve()
    name = f"_method_file_{sha256(str(whole).encode()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, whole)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Data classes and pickles look their module up by its name.
    sys.modules[name] = module
    require_own_packages()
    if str(whole.parent) not in sys.path:
        sys.path.append(str(whole.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise InputError(f"{path} fails while it is loaded: {_fault(error, whole)}; correct it") from error
    return module


def _module_by_name(name: str) -> ModuleType:
    require_own_packages()
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if name == missing or name.startswith(f"{missing}."):
            raise InputError(
                f"there is no module {name!r}; install it, or give the path of a file that ends in .py"
            ) from error
        raise InputError(f"module {name} needs {missing!r}, which is not installed; install it") from error
    except (Exception, SystemExit) as error:
        raise InputError(f"module {name} fails while it is loaded: {_fault(error)}; correct it") from error


def _fault(error: BaseException, file: Path | None = None) -> str:
    """Return what went wrong, with the last line of `file` that it went through, or the last file and line at all.

    The lines of this file, which called what failed, are of no use to who wrote it: without others there is none.
    """
    if isinstance(error, SyntaxError) and error.lineno:
        return f"line {error.lineno}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename == str(file) or (file is None and frame.filename != __file__)]
    whose = f"{Path(own[-1].filename).name}, " if own and file is None else ""
    place = f"{whose}line {own[-1].lineno}: " if own else ""
    return f"{place}{type(error).__name__}: {error}"
