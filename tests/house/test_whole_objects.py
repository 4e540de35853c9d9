"""Objects are whole when they are made: no attribute appears first in the middle of a class's life.

A class may set an attribute in a method only if its body names it, or its `__init__` (or that of a class it is made
from) assigns it. Classes are found by the names under which modules import them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import pytest

from foundation.version import PACKAGES
from tests.house.sources import sources


@dataclass
class Shape:
    """What is known of a class: names of its bases, attributes it is made with, attributes its methods assign."""

    bases: list[str]
    made_with: set[str] = field(default_factory=set[str])
    assigned: dict[str, int] = field(default_factory=dict[str, int])


def attributes(function: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the attributes of `self` that a method assigns, each with its line."""
    for node in ast.walk(function):
        match node:
            case ast.Attribute(value=ast.Name(id="self"), attr=name, ctx=ast.Store()):
                yield name, node.lineno
            case _:
                pass


def shape_of(node: ast.ClassDef) -> Shape:
    """Return what a class body says."""
    shape = Shape([ast.unparse(base).rpartition(".")[2].partition("[")[0] for base in node.bases])
    for item in node.body:
        match item:
            case ast.AnnAssign(target=ast.Name(id=name)):
                shape.made_with.add(name)
            case ast.Assign(targets=targets):
                shape.made_with.update(target.id for target in targets if isinstance(target, ast.Name))
            case ast.FunctionDef(name="__init__" | "__new__"):
                shape.made_with.update(name for name, _ in attributes(item))
            case ast.FunctionDef():
                if any(isinstance(mark, ast.Attribute) and mark.attr == "setter" for mark in item.decorator_list):
                    shape.made_with.add(item.name)
                if any(ast.unparse(mark).endswith("property") for mark in item.decorator_list):
                    shape.made_with.add(item.name)
                for name, line in attributes(item):
                    shape.assigned.setdefault(name, line)
            case _:
                pass
    return shape


@cache
def shapes() -> dict[str, list[tuple[Path, Shape]]]:
    """Return every class of the product by its name."""
    found: dict[str, list[tuple[Path, Shape]]] = {}
    for package in PACKAGES:
        for source in sources(package):
            for node in ast.walk(source.tree):
                if isinstance(node, ast.ClassDef):
                    found.setdefault(node.name, []).append((source.path, shape_of(node)))
    return found


def made_with(shape: Shape) -> set[str]:
    """Return the attributes that an object has after its `__init__`, its bases' included."""
    known = set(shape.made_with)
    for base in shape.bases:
        for _, other in shapes().get(base, []):
            known |= made_with(other)
    return known


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_no_attribute_appears_after_its_object_was_made(package: str) -> None:
    late = [
        f"{path}:{line} {name}.{attribute}"
        for name, homes in shapes().items()
        for path, shape in homes
        if path.parts[0] == package
        for attribute, line in shape.assigned.items()
        if attribute not in made_with(shape)
    ]
    assert late == []
