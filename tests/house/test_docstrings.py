"""Arrays say their shape, and numbers their reason.

Every public function states the shape of each array that it takes or gives, in the entry of its docstring for that
parameter or, where there is none, before the sections; and the kind of number where the annotation leaves it open.
Every numeric constant of a module stands next to its reason: in the string below it, in a comment above or beside it,
or in the comment above the run of lines of which it is a member (a table of the codes of a standard, say).
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache

import pytest

from foundation.version import PACKAGES
from tests.house.sources import sources

Function = ast.FunctionDef | ast.AsyncFunctionDef

_NAMED = "height|width|rows|columns|lights|colours|cells|samples|count|photosites"
_LENGTH = re.compile(rf"\.\.\.|[0-9]+(?:\*\*[a-z]+)?|[A-Z][a-z]?(?: (?:[-+*·]|//) [A-Z0-9])*|[hwn]|{_NAMED}")
_DIMENSION = re.compile(r"\.\.\.|[\w */+·²-]{1,20}")
_SAME_SHAPE = re.compile(r"\bscalar|\b(?:any|same|one|its|that|the) shape\b")
DTYPE = re.compile(r"\b(?:u?int(?:8|16|32|64)?|float(?:16|32|64)?|bool|dtype)\b")
_OPEN_DTYPES = re.compile(r"\bArrayLike\b|NDArray\[[^]]*\b(?:Any|generic|number|floating|\w*integer|inexact)\b")
_ARRAY = re.compile(r"\bNDArray\b|\bArrayLike\b")
_CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")


def aliases(tree: ast.Module) -> dict[str, str]:
    """Return the module's own names for arrays, each with what it stands for."""
    found: dict[str, str] = {}
    for node in tree.body:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                pass
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                pass
            case _:
                continue
        if isinstance(value, ast.Subscript | ast.Attribute | ast.BinOp):
            text = re.sub(r"\b(\w+)\b", lambda word: found.get(word[1], word[1]), ast.unparse(value))
            if _ARRAY.search(text):
                found[name] = text
    return found


@cache
def public() -> dict[tuple[str, str], str]:
    """Return what the names for arrays stand for, by module and name."""
    return {
        (".".join(source.path.with_suffix("").parts), name): text
        for package in PACKAGES
        for source in sources(package)
        if _ARRAY.search(source.text)
        for name, text in aliases(source.tree).items()
    }


def known_arrays(tree: ast.Module) -> dict[str, str]:
    """Return the names for arrays that a module has or imports."""
    imported = {
        item.asname or item.name: public()[node.module, item.name]
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module
        for item in node.names
        if (node.module, item.name) in public()
    }
    return imported | aliases(tree)


def has_shape(text: str) -> bool:
    """Return whether a text has a shape, such as (H, W, 3) or (...), or says that there is none to say."""
    for found in re.findall(r"\(([^()]*)\)", text):
        parts = [part.strip() for part in found.split(",")]
        if parts[-1] == "" and len(parts) == 2:
            parts.pop()
        elif len(parts) == 1 and found != "...":
            continue
        if all(map(_DIMENSION.fullmatch, parts)) and any(map(_LENGTH.fullmatch, parts)):
            return True
    return _SAME_SHAPE.search(text) is not None


def public_functions(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, Function]]:
    """Yield the public functions and methods of public classes, of overloads only what they stand for."""
    for node in body:
        match node:
            case ast.ClassDef(name=name) if not name.startswith("_"):
                yield from public_functions(node.body, f"{prefix}{name}.")
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) if not name.startswith("_"):
                if not any(ast.unparse(mark).endswith(("overload", ".setter")) for mark in node.decorator_list):
                    yield prefix + name, node
            case ast.If() | ast.Try():
                yield from public_functions(node.body, prefix)
                yield from public_functions(node.orelse, prefix)
            case _:
                pass


def arrays_of(function: Function, known: dict[str, str]) -> dict[str, str]:
    """Return the arrays of a signature, parameters by name and what is returned as `return`, with their annotations."""
    every = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    every += [rest for rest in (function.args.vararg, function.args.kwarg) if rest]
    notes = [(argument.arg, argument.annotation) for argument in every] + [("return", function.returns)]
    written = {
        name: re.sub(r"\b(\w+)\b", lambda word: known.get(word[1], word[1]), ast.unparse(note))
        for name, note in notes
        if note
    }
    return {name: text for name, text in written.items() if _ARRAY.search(text)}


def entries(docstring: str) -> tuple[str, dict[str, str]]:
    """Return the text before a numpy docstring's sections, and the entries of parameters and returned values."""
    head, *rest = re.split(r"^(\w+)\n-{3,}\n", docstring, flags=re.MULTILINE)
    found: dict[str, str] = {}
    for title, body in zip(rest[::2], rest[1::2], strict=True):
        if title in ("Returns", "Yields"):
            found["return"] = body
        elif title == "Parameters":
            names = re.split(r"^(\w[\w, ]*)$", body, flags=re.MULTILINE)
            for name, text in zip(names[1::2], names[2::2], strict=True):
                found |= dict.fromkeys(name.split(", "), text)
    return head, found


def without_shape(package: str) -> list[str]:
    """Return the arrays of public functions of which no shape is stated, or no dtype where it is open."""
    missing: list[str] = []
    for source in sources(package):
        path, known = source.path, known_arrays(source.tree)
        if not known and not _ARRAY.search(source.text):
            continue
        for name, function in public_functions(source.tree.body):
            head, described = entries(ast.get_docstring(function) or "")
            for array, annotation in arrays_of(function, known).items():
                says = " ".join((described.get(array) or head).split())
                if not has_shape(says):
                    missing.append(f"{path}:{function.lineno} {name}({array}): no shape")
                elif _OPEN_DTYPES.search(annotation) and not DTYPE.search(says):
                    missing.append(f"{path}:{function.lineno} {name}({array}): no dtype")
    return missing


def is_number(value: ast.expr) -> bool:
    """Return whether an expression is a number, arithmetic with numbers and other constants, or several of these."""
    match value:
        case ast.Constant(value=int() | float()):
            return not isinstance(value.value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return any(map(is_number, (left, right))) and all(
                is_number(side) or (isinstance(side, ast.Name) and _CONSTANT.fullmatch(side.id) is not None)
                for side in (left, right)
            )
        case ast.Tuple(elts=items) | ast.List(elts=items):
            return bool(items) and all(map(is_number, items))
        case _:
            return False


def constants(tree: ast.Module) -> Iterator[tuple[str, ast.stmt, ast.stmt | None]]:
    """Yield the numeric constants of a module, each with the statement that follows it."""
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        match node:
            case ast.Assign(targets=targets, value=value):
                pass
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                targets = [target]
            case _:
                continue
        names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        if is_number(value) and all(map(_CONSTANT.fullmatch, names)):
            yield ", ".join(names), node, after


def has_reason(node: ast.stmt, after: ast.stmt | None, lines: list[str]) -> bool:
    """Return whether a constant stands next to its reason."""
    match after:
        case ast.Expr(value=ast.Constant(value=str())):
            return True
        case _:
            pass
    end = node.end_lineno or node.lineno
    if any("#" in line for line in lines[node.lineno - 1 : end]):
        return True
    first = node.lineno - 1
    while first and re.match(r"_?[A-Z][A-Z0-9_]*(, _?[A-Z][A-Z0-9_]*)* *[:=]", lines[first - 1]):
        first -= 1
    return first > 0 and lines[first - 1].startswith("#")


def without_reason(package: str) -> list[str]:
    """Return the numeric constants of a package that stand without a reason."""
    return [
        f"{source.path}:{node.lineno} {name}"
        for source in sources(package)
        for lines in (source.text.splitlines(),)
        for name, node, after in constants(source.tree)
        if not has_reason(node, after, lines)
    ]


@pytest.mark.parametrize("text", ["(N, 2) px", "(3,)", "(...) float64", "(8**bits, S, 3)", "of any shape", "a scalar"])
def test_a_shape_is_seen(text: str) -> None:
    assert has_shape(text)


@pytest.mark.parametrize("text", ["counts", "(x)", "(paper, equation 3)", "f(a, b)", "0.5 (judgement)", "(DNG 1.7)"])
def test_prose_is_no_shape(text: str) -> None:
    assert not has_shape(text)


@pytest.mark.parametrize(
    ("source", "reasoned"),
    [
        ("A = 3", False),
        ('A = 3\n"""Why three."""', True),
        ("# Clause 5.\nA = 3\n_B: Final = 1 << 4", True),
        ('A, B = 3, -4\n\n"""Why these."""', True),
        ("A = 3  # why", True),
        ('"""A module."""\nA = 2 * B', False),
    ],
)
def test_a_reason_is_seen(source: str, reasoned: bool) -> None:
    found = [has_reason(node, after, source.splitlines()) for _, node, after in constants(ast.parse(source))]
    assert found
    assert all(found) is reasoned


# For all packages at once: reading them takes seconds.
@pytest.mark.slow
def test_public_array_functions_state_shape_and_dtype() -> None:
    assert [one for package in PACKAGES for one in without_shape(package)] == []


@pytest.mark.slow
def test_numeric_constants_state_their_reason() -> None:
    assert [one for package in PACKAGES for one in without_reason(package)] == []
