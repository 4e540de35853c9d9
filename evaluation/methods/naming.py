"""Find a method by its name: a method of this suite, a class of an installed module, or a class in a file.

    gray-edge-1            a method of `standard.standard_methods`
    gray-edge-1:p=4:sigma=2, shades-of-gray:p=6      a method of the Gray-Edge framework with other parameters
    package.module:Class   a class or value of an installed module, or of a module in the working folder
    path/file.py:Class     a class or value of a file, which can import modules of its folder

All of these can have a suffix:

    gray-edge-2@360        applied to images reduced to a longer side of 360 px (`wrapped.ResizedMethod`)
    gray-world@patches     applied to a grid with 8 patches along the shorter side (`wrapped.PatchwiseMethod`)
    gray-world@patches=12  with 12 patches along the shorter side

A class is called without arguments; any other value is used unchanged. Example of a file::

    import numpy as np

    class Brightest:
        name = "Brightest pixel"

        def estimate(self, image, saturation=None, mask=None):
            usable = np.ones(image.shape[:2], bool) if mask is None else ~mask
            pixels = image[usable].astype(np.float64)
            light = pixels[pixels.sum(axis=1).argmax()]
            return light / np.linalg.norm(light)

Loading a file or module runs its code, so use only files and modules that you trust.
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

FAMILIES = ("shades-of-gray", "general-gray-world", "gray-edge-1", "gray-edge-2")  # methods with parameters

_MODIFIERS = re.compile(r"(?P<size>[0-9]{1,6})|patches(=(?P<patches>[0-9]{1,6}))?")

# Largest accepted scale of a Gaussian, px. It limits the width of the filter.
LARGEST_SIGMA = 1000

_NAME_FORMS = "a name of this suite, module:Class or path/file.py:Class"


def find_method(text: str) -> Method | Learner:
    """Return the method or learner with a name, see the module docstring; raise InputError if there is none.

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
    name = text.strip()
    inner_name, separator, suffix = name.rpartition("@")
    modifier = _MODIFIERS.fullmatch(suffix) if separator else None
    if modifier is not None:
        method = find_method(inner_name)
        if not callable(getattr(method, "estimate", None)):
            raise InputError(f"{name}: {inner_name} is not trained, expected a trained method; give its model instead")
        number = int(modifier["size"] or modifier["patches"] or PATCHES)
        if not number:
            raise InputError(f"{name}: {number} after @, expected 1 or more; correct it")
        if modifier["size"]:
            return ResizedMethod(cast("Method", method), number)
        return PatchwiseMethod(cast("Method", method), number)
    family, colon, parameters = name.partition(":")
    if colon and family in standard_methods():
        return _parse_parameters(family, parameters)
    location, colon, class_name = name.rpartition(":")
    if not colon:
        methods = {**standard_methods(), **local_methods()}
        if name in methods:
            return methods[name]
        suggestion = nearest_names(name, methods) or f"the methods are {', '.join(methods)}"
        raise InputError(f"method {name!r} is unknown; {suggestion}; give your own as module:Class or file.py:Class")
    if not location or not class_name:
        raise InputError(f"method {name!r} is incomplete, expected {_NAME_FORMS}; complete it")
    is_file = location.endswith(".py")
    module = _load_file(Path(location)) if is_file else _load_module(location)
    candidate = getattr(module, class_name, None)
    if candidate is None and location in PACKAGES and Path(f"{location}.py").is_file():
        raise InputError(
            f"{name}: {location} is a package of this suite without {class_name!r}; for your file of that name, give "
            f"{location}.py:{class_name}"
        )
    if candidate is None:
        alternatives = ", ".join(sorted(key for key in vars(module) if _looks_like_method(module, key))) or "none"
        raise InputError(f"{location} has no {class_name!r}, expected a class with estimate or fit: {alternatives}")
    if isinstance(candidate, type):
        try:
            candidate = cast("object", candidate())
        except (Exception, SystemExit) as error:
            raise InputError(
                f"{name} cannot be called without arguments: {_describe_failure(error)}; add defaults to its "
                "parameters, or give a value of the file instead of the class"
            ) from error
    return check_method(candidate, name)


def _parse_parameters(family: str, parameters: str) -> Method:
    # `parameters` is "p=4:sigma=2", in any order.
    standard = standard_methods()[family]
    if family not in FAMILIES or not isinstance(standard, GrayEdge):
        raise InputError(f"{family} has no parameters, expected one of {', '.join(FAMILIES)}; remove the parameters")
    parameter_names = ("p", "sigma") if standard.sigma else ("p",)
    values: dict[str, float] = {}
    for assignment in parameters.split(":"):
        name, _, text = assignment.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if name not in parameter_names or name in values or math.isnan(value):
            expected = " and ".join(f"{name}=NUMBER" for name in parameter_names)
            raise InputError(f"{family}:{parameters}: {assignment!r}, expected {expected}, once each, separated by :")
        values[name] = value
    p, sigma = values.get("p", standard.p), values.get("sigma", standard.sigma)
    if p < 1 or sigma > LARGEST_SIGMA or (standard.sigma and sigma <= 0):
        raise InputError(
            f"{family}:{parameters}: p {p:g} and sigma {sigma:g}, expected p of 1 or more and sigma above 0, up to "
            f"{LARGEST_SIGMA} px; correct them"
        )
    title = standard.name.partition(" (")[0]
    scale = f", σ={sigma:g}" if standard.sigma else ""
    return GrayEdge(f"{title} (p={p:g}{scale})", standard.order, p, sigma)


def check_method(candidate: object, location: str) -> Method | Learner:
    """Return a candidate that is a method or a learner; raise InputError if it is neither.

    Examples
    --------
    >>> class Nameless:
    ...     def estimate(self, image, saturation=None, mask=None):
    ...         return image.mean(axis=(0, 1))
    >>> check_method(Nameless(), "own.py:Nameless")
    Traceback (most recent call last):
        ...
    foundation.errors.InputError: own.py:Nameless has no name; add name = "…", the text for tables
    """
    if not callable(getattr(candidate, "estimate", None)) and not callable(getattr(candidate, "fit", None)):
        if callable(getattr(candidate, "estimate_map", None)):
            raise InputError(
                f"{location} has only estimate_map, expected also estimate(image, saturation, mask) for images under "
                "one illuminant; add it"
            )
        raise InputError(
            f"{location} has no method estimate(image, saturation, mask) or fit(scenes, seed), expected one of them; "
            "add it, see docs/how-to/evaluate.md"
        )
    try:
        name = getattr(candidate, "name", None)
    except Exception as error:
        raise InputError(f"{location}.name raises an error: {_describe_failure(error)}; correct it") from error
    if not isinstance(name, str) or not name:
        raise InputError(f'{location} has no name; add name = "…", the text for tables')
    return cast("Method | Learner", candidate)


def _looks_like_method(module: ModuleType, name: str) -> bool:
    attribute = getattr(module, name)
    return not name.startswith("_") and (hasattr(attribute, "estimate") or hasattr(attribute, "fit"))


def _load_file(path: Path) -> ModuleType:
    # A file is run once per process, so that all its methods belong to the same module.
    if not path.is_file():
        raise InputError(f"{path} does not exist, expected a Python file with the class of a method; correct the path")
    resolved = path.resolve()
    name = f"_method_file_{sha256(str(resolved).encode()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, resolved)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Data classes and pickles require their module in sys.modules.
    sys.modules[name] = module
    require_own_packages()
    if str(resolved.parent) not in sys.path:
        sys.path.append(str(resolved.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise InputError(f"{path} fails when loaded: {_describe_failure(error, resolved)}; correct it") from error
    return module


def _load_module(name: str) -> ModuleType:
    require_own_packages()
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if name == missing or name.startswith(f"{missing}."):
            raise InputError(
                f"module {name!r} does not exist; install it, or give the path of a file that ends in .py"
            ) from error
        raise InputError(f"module {name} requires {missing!r}, which is not installed; install it") from error
    except (Exception, SystemExit) as error:
        raise InputError(f"module {name} fails when loaded: {_describe_failure(error)}; correct it") from error


def _describe_failure(error: BaseException, file: Path | None = None) -> str:
    """Return the error and the last line of `file` that caused it; without `file`, return the last file and line."""
    # Lines of naming.py itself do not help the author of the method.
    if isinstance(error, SyntaxError) and error.lineno:
        return f"line {error.lineno}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename == str(file) or (file is None and frame.filename != __file__)]
    file_name = f"{Path(own[-1].filename).name}, " if own and file is None else ""
    position = f"{file_name}line {own[-1].lineno}: " if own else ""
    return f"{position}{type(error).__name__}: {error}"
