"""The plan of the house, measured: no import circles, rooms and files of a size, one home for each class name.

The product is the packages that `pyproject.toml` names to import-linter. The walls between rooms are contracts there;
here are the rules that no contract can state.
"""

from __future__ import annotations

import ast
import statistics
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES: list[str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

FILES_IN_A_ROOM = 12
LINES_OF_A_FILE = 500
MEDIAN_LINES = 170
CONSTRUCTORS = {"__init__", "__post_init__", "__new__"}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def place(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_is_there(package: str) -> None:
    assert (ROOT / package / "__init__.py").is_file()


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    circle: list[str] = []
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        circle = error.args[1]
    assert not circle, f"imports go round: {' <- '.join(circle)}; move what both need to a module below them"


def test_a_room_has_few_files() -> None:
    rooms: defaultdict[Path, list[str]] = defaultdict(list)
    for path in FILES:
        if path.name != "__init__.py":
            rooms[path.parent].append(path.name)
    crowded = {place(room): len(files) for room, files in rooms.items() if len(files) > FILES_IN_A_ROOM}
    assert not crowded, f"more than {FILES_IN_A_ROOM} files: {crowded}"


def test_a_file_can_be_read_in_one_go() -> None:
    lines = {place(path): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    long = {file: count for file, count in lines.items() if count > LINES_OF_A_FILE}
    assert not long, f"more than {LINES_OF_A_FILE} lines: {long}"
    # A package's opening is one line in most, and no measure of how long files are.
    median = statistics.median(count for file, count in lines.items() if not file.endswith("__init__.py"))
    assert median < MEDIAN_LINES


def test_a_public_class_name_has_one_home() -> None:
    homes: defaultdict[str, list[str]] = defaultdict(list)
    for path in FILES:
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(place(path))
    shared = {name: files for name, files in homes.items() if len(files) > 1}
    assert not shared


def test_an_object_is_whole_when_its_constructor_returns() -> None:
    classes = {node.name: node for path in FILES for node in ast.walk(tree_of(path)) if isinstance(node, ast.ClassDef)}
    late = [
        f"{place(path)}:{line} {node.name}.{attribute}"
        for path in FILES
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.ClassDef)
        for attribute, line in assigned_late(node, classes)
    ]
    assert not late, "first assigned outside the constructor:\n" + "\n".join(late)


def assigned_late(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> Iterator[tuple[str, int]]:
    """Yield the attributes that methods assign and neither constructor nor class body, of the bases neither."""
    known = attributes_at_birth(node, classes)
    for method in methods_of(node):
        if method.name in CONSTRUCTORS:
            continue
        for attribute, line in assigned_in(method):
            if attribute not in known:
                known.add(attribute)
                yield attribute, line


def attributes_at_birth(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """Return the names an object has when its constructor returns, those of base classes in the product included."""
    known: set[str] = set()
    for base in node.bases:
        name = base.value if isinstance(base, ast.Subscript) else base
        parent = classes.get(name.id) if isinstance(name, ast.Name) else None
        if parent is not None and parent is not node:
            known |= attributes_at_birth(parent, classes)
    for statement in node.body:
        match statement:
            case ast.FunctionDef(name=name) | ast.AnnAssign(target=ast.Name(id=name)):
                known.add(name)
            case ast.Assign(targets=targets):
                known |= {target.id for target in targets if isinstance(target, ast.Name)}
            case _:
                pass
    for method in methods_of(node):
        if method.name in CONSTRUCTORS:
            known |= {attribute for attribute, _ in assigned_in(method)}
    return known


def methods_of(node: ast.ClassDef) -> Iterator[ast.FunctionDef]:
    """Yield the functions of a class body that have a first parameter and are no static or class methods."""
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef) and statement.args.args:
            marks = {mark.id for mark in statement.decorator_list if isinstance(mark, ast.Name)}
            if not marks & {"staticmethod", "classmethod"}:
                yield statement


def assigned_in(method: ast.FunctionDef) -> Iterator[tuple[str, int]]:
    """Yield each attribute of its object that a method assigns, in whatever statement, with the line."""
    own = method.args.args[0].arg
    for node in ast.walk(method):
        match node:
            case ast.Attribute(value=ast.Name(id=name), attr=attribute, ctx=ast.Store()) if name == own:
                yield attribute, node.lineno
            case _:
                pass
