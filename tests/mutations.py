"""Draw mutations of the product at random and count those that no test notices.

`python -m tests.mutations [--count 60] [--seed 1] [--jobs 2]` changes one place at a time in a copy of the repository
(a comparison, an operator, a number), runs the tests near it, and prints one JSON object a mutation and one
for the whole. Every place is as likely, so that packages have their share by size. A mutation is killed where a test
fails or does not end in time. Tests are tried from near to far and the first failure ends a try: those that import the
module, those of its package, whole commands and the packages above; what survives these is said to survive.

Not drawn are annotations, messages, numbers that are an index, and what only type checkers read.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).parents[1]
PACKAGES: list[str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]
COPIED = (
    *PACKAGES,
    "tests",
    "benchmarks",
    "examples",
    "docs",
    "pyproject.toml",
    "CONTRIBUTING.md",
    "README.md",
    "Makefile",
)
LIMIT_S = 1200.0
"""Time for the tests of one stage: ten times what the slowest take on two busy cores."""

OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
}  # fmt: skip
"""What stands in the place of each operator."""


@dataclass(frozen=True)
class Mutation:
    """One changed place: its file, relative to the checkout, line, old and new source of the expression."""

    file: str
    line: int
    before: str
    after: str
    column: int
    end: tuple[int, int]

    def apply(self, folder: Path) -> str:
        """Change the place in a copy of the checkout and return the file's text as it was."""
        path = folder / self.file
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines(keepends=True)
        last, column = self.end
        # ast counts columns in bytes of UTF-8.
        head = lines[self.line - 1].encode()[: self.column].decode()
        tail = lines[last - 1].encode()[column:].decode()
        lines[self.line - 1 : last] = [f"{head}({self.after}){tail}"]
        path.write_text("".join(lines), encoding="utf-8")
        return text


def mutated(node: ast.expr) -> Iterator[ast.expr]:
    """Yield an expression's mutations."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in OTHER:
            yield ast.Compare(node.left, [OTHER[type(op)]()], node.comparators)  # pyright: ignore[reportArgumentType]
        case ast.BoolOp(op=op):
            yield ast.BoolOp(OTHER[type(op)](), node.values)  # pyright: ignore[reportArgumentType]
        case ast.BinOp(op=op) if type(op) in OTHER and not _is_text(node):
            yield ast.BinOp(node.left, OTHER[type(op)](), node.right)  # pyright: ignore[reportArgumentType]
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield operand
        case ast.IfExp(test=test):
            yield ast.IfExp(ast.UnaryOp(ast.Not(), test), node.body, node.orelse)
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            yield ast.Constant(number * 2 if number not in (0, 1) else 1 - number)
        case _:
            pass


def _is_text(node: ast.BinOp) -> bool:
    return any(isinstance(side, ast.JoinedStr) or (isinstance(side, ast.Constant) and isinstance(side.value, str))
               for side in (node.left, node.right))  # fmt: skip


def places(path: Path) -> Iterator[Mutation]:
    """Yield every mutation of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left_out = set[int]()
    for node in ast.walk(tree):
        skipped: list[ast.AST] = []
        match node:
            case ast.arg(annotation=ast.expr() as note) | ast.AnnAssign(annotation=note):
                skipped = [note]
            case ast.FunctionDef(returns=ast.expr() as note):
                skipped = [note]
            case ast.JoinedStr() | ast.Raise():
                skipped = [node]
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                skipped = [node]
            case ast.Subscript(slice=index):
                skipped = [one for one in ast.walk(index) if isinstance(one, ast.Constant)]
            case _:
                pass
        left_out |= {id(inner) for one in skipped for inner in ast.walk(one)}
    for node in ast.walk(tree):
        if isinstance(node, ast.expr) and id(node) not in left_out:
            for after in mutated(node):
                end = node.end_lineno or node.lineno, node.end_col_offset or 0
                file = str(path.relative_to(ROOT))
                yield Mutation(file, node.lineno, ast.unparse(node), ast.unparse(after), node.col_offset, end)


def drawn(count: int, seed: int) -> list[Mutation]:
    """Return mutations of all packages, each package's share by its number of places."""
    every = [one for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")) for one in places(path)]
    return random.Random(seed).sample(every, count)


def stages(mutation: Mutation) -> list[list[str]]:
    """Return the test files to try, from near to far."""
    module = mutation.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    package, _, name = module.rpartition(".")
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    texts = {path: path.read_text(encoding="utf-8") for path in files}
    direct = [path for path, text in texts.items() if module in text or f"from {package} import {name}" in text]
    root = module.split(".")[0]
    own = [path for path in files if path.is_relative_to(ROOT / "tests" / root)]
    whole = [path for path in files if path.is_relative_to(ROOT / "tests" / "end_to_end")]
    above = [path for path, text in texts.items() if f"from {root}" in text]
    found: list[list[str]] = []
    seen = set[Path]()
    for stage in (direct, own, [*whole, *above]):
        new = [path for path in stage if path not in seen]
        seen |= set(new)
        if new:
            found.append([str(path.relative_to(ROOT)) for path in new])
    return found


def killed_by(mutation: Mutation, folder: Path) -> str:
    """Return the first test that notices a mutation in a copy of the checkout; "" where none does."""
    text = mutation.apply(folder)
    settings = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "--no-header", "-p", "no:cacheprovider", "-rf"]
    try:
        for stage in stages(mutation):
            try:
                done = subprocess.run(
                    [*words, *stage],
                    cwd=folder,
                    env=settings,
                    capture_output=True,
                    text=True,
                    timeout=LIMIT_S,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                return "no end"
            if done.returncode not in (0, 5):
                lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
                return (lines or ["not imported"])[0].split(" - ")[0]
    finally:
        (folder / mutation.file).write_text(text, encoding="utf-8")
    return ""


def copied(folder: Path) -> Path:
    """Return a copy of the checkout in a folder."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, try and print; return 0 where at least nine of ten are killed, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="mutations")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="mutations tried at a time")
    parser.add_argument("--list", action="store_true", help="print the draw and try nothing")
    given = parser.parse_args(argv)
    mutations = drawn(given.count, given.seed)
    if given.list:
        for one in mutations:
            print(f"{one.file}:{one.line}: {one.before}  ->  {one.after}")
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        free: Queue[Path] = Queue()
        for number in range(given.jobs):
            free.put(copied(Path(scratch) / str(number)))

        def tried(mutation: Mutation) -> bool:
            folder = free.get()
            try:
                by = killed_by(mutation, folder)
            finally:
                free.put(folder)
            row = {"file": mutation.file, "line": mutation.line, "before": mutation.before, "after": mutation.after}
            print(json.dumps(row | {"killed by": by or None}), flush=True)
            return bool(by)

        with ThreadPoolExecutor(given.jobs) as pool:
            killed = sum(pool.map(tried, mutations))
    print(json.dumps({"name": "mutations killed", "value": killed, "unit": "", "against": f"{given.count} drawn"}))
    return 0 if killed >= 0.9 * given.count else 1


if __name__ == "__main__":
    raise SystemExit(main())
