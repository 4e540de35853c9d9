"""Draw mutations of the product at random and count those that no test notices.

`python -m tests.mutations [--count 60] [--seed 1] [--results FILE]` changes one place at a time in a copy of the
repository (a comparison, an operator, a number), runs the tests that can reach it, and prints one JSON object
a mutation and one for the whole. Every place is as likely, so that packages have their share by size. A mutation is
killed where a test fails or does not end, and passes without it. Tests are tried from near to far, by the
imports that lead from them to the module, quick ones first, until one fails or `--limit` seconds are over: what
survives these is said to survive. `--results` keeps what was tried, so that a run that was stopped goes on;
`--again` tries what survived there once more, wherever its line is now.

Not drawn are annotations, messages, numbers that are an index, and what only type checkers read.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from queue import Queue
from typing import Any

import grimp

ROOT = Path(__file__).parents[1]
PACKAGES: list[str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]
ENDLESS_S = 90
"""Time after which a test is said not to end: half as long again as the slowest takes beside others."""

STOPPED_AT = re.compile(
    r"^(tests/.*?::.*?)(?: <- \S+)?(?: (?:PASSED|SKIPPED|XFAIL|FAILED|ERROR)\b.*| ?)$|^ERROR (tests/[^:\s]*)(?: |$)",
    re.MULTILINE,
)
"""The test at which pytest stopped: it failed, it has no outcome, or its file cannot be imported."""

OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
}  # fmt: skip
"""What stands in the place of each operator."""


@dataclass(frozen=True)
class Mutation:
    """One changed place: its file, relative to the checkout, line, old and new source of the expression.

    `text`: the line as it stands, by which the place is found again where others have moved it.
    """

    file: str
    line: int
    before: str
    after: str
    column: int
    last_line: int
    last_column: int
    text: str

    def apply(self, folder: Path) -> str:
        """Change the place in a copy of the checkout and return the file's text as it was."""
        path = folder / self.file
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines(keepends=True)
        # ast counts columns in bytes of UTF-8.
        head = lines[self.line - 1].encode()[: self.column].decode()
        tail = lines[self.last_line - 1].encode()[self.last_column :].decode()
        lines[self.line - 1 : self.last_line] = [f"{head}({self.after}){tail}"]
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
    source = path.read_text(encoding="utf-8")
    tree, lines = ast.parse(source), source.splitlines()
    left_out = set[int]()
    for node in ast.walk(tree):
        skipped: list[ast.AST] = []
        match node:
            case ast.arg(annotation=ast.expr() as note) | ast.AnnAssign(annotation=note):
                skipped = [note]
            case ast.FunctionDef(returns=ast.expr() as note):
                skipped = [note]
            case ast.JoinedStr() | ast.Raise() | ast.MatchValue():
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
                yield Mutation(
                    str(path.relative_to(ROOT)),
                    node.lineno,
                    ast.unparse(node),
                    ast.unparse(after),
                    node.col_offset,
                    node.end_lineno or node.lineno,
                    node.end_col_offset or 0,
                    lines[node.lineno - 1].strip(),
                )


def drawn(count: int, seed: int) -> list[Mutation]:
    """Return mutations of all packages, each package's share by its number of places."""
    every = [one for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")) for one in places(path)]
    return random.Random(seed).sample(every, count)


def survivors(results: Path) -> list[Mutation]:
    """Return the mutations that survived by a file of results, at their places as of now, where these still are."""
    latest = {Mutation(**row["mutation"]): row["killed by"] for row in _rows(results)}
    found: list[Mutation] = []
    for old in (one for one, by in latest.items() if not by):
        said = (old.before, old.after, old.text)
        alike = [one for one in places(ROOT / old.file) if (one.before, one.after, one.text) == said]
        if not alike:
            print(f"{old.file}:{old.line}: {old.text!r} is not there any more", file=sys.stderr)
        found += sorted(alike, key=lambda one: (abs(one.line - old.line), abs(one.column - old.column)))[:1]
    return found


def _rows(results: Path | None) -> list[dict[str, Any]]:
    """Return what is in a file of results."""
    text = results.read_text(encoding="utf-8") if results and results.exists() else ""
    return [json.loads(line) for line in text.splitlines()]


@cache
def _imported_by_tests() -> dict[Path, dict[str, int]]:
    """Return each test file with the names it imports (0), and those that helpers and conftest.py import for it (1)."""
    tests = ROOT / "tests"
    named = dict[Path, set[str]]()
    for path in tests.rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        froms = [one for one in nodes if isinstance(one, ast.ImportFrom) and one.module]
        named[path] = {f"{one.module}.{alias.name}" for one in froms for alias in one.names}
        named[path] |= {one.module for one in froms if one.module}
        named[path] |= {alias.name for one in nodes if isinstance(one, ast.Import) for alias in one.names}
    found = dict[Path, dict[str, int]]()
    for path in sorted(one for one in named if one.name.startswith("test_")):
        waiting = [path, *(folder / "conftest.py" for folder in path.parents if folder.is_relative_to(tests))]
        for one in waiting:
            helpers = {ROOT.joinpath(*name.split(".")).with_suffix(".py") for name in named.get(one, ())}
            waiting += sorted((helpers & named.keys()) - {*waiting})
        behind = set[str]().union(*(named.get(one, ()) for one in waiting))
        found[path] = dict.fromkeys(behind, 1) | dict.fromkeys(named[path], 0)
    return found


@cache
def _imports() -> grimp.ImportGraph:
    return grimp.build_graph(PACKAGES[0], *PACKAGES[1:])


def stages(mutation: Mutation) -> list[tuple[str, list[str]]]:
    """Return the test files to try, each lot with the option that says which of its tests, from near to far."""
    module = mutation.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    room = ROOT / "tests" / Path(mutation.file).parent
    distance = {module: 0}
    waiting = [module]
    for name in waiting:
        nearer = _imports().find_modules_that_directly_import(name) - distance.keys()
        distance |= dict.fromkeys(nearer, distance[name] + 1)
        waiting += sorted(nearer)
    lots: tuple[list[str], ...] = ([], [], [])
    for path, names in _imported_by_tests().items():
        steps = min((distance[name] + further for name, further in names.items() if name in distance), default=None)
        in_room = path.is_relative_to(room)
        if steps == 0 or (in_room and path.stem == f"test_{Path(mutation.file).stem}"):
            lots[0].append(str(path.relative_to(ROOT)))
        elif steps is not None or in_room:
            lots[1 if in_room or steps == 1 else 2].append(str(path.relative_to(ROOT)))
    for lot in lots:
        lot.sort(key=lambda file: not (ROOT / file).is_relative_to(room))
    order = (("not slow", 0), ("not slow", 1), ("slow", 0), ("not slow", 2), ("slow", 1), ("slow", 2))
    return [(which, lots[near]) for which, near in order if lots[near]]


def killed_by(mutation: Mutation, folder: Path, limit_s: float, left_out: tuple[str, ...] = ()) -> str:
    """Return the first test that notices a mutation in a copy of the checkout; "" where none does in the time.

    `left_out`: tests that are not asked, since they fail without it, too.
    """
    end_s = time.monotonic() + limit_s
    known_text = mutation.apply(folder)
    deselected = [f"--deselect={test}" for test in left_out]
    try:
        for which, files in stages(mutation):
            code, failed = tested(folder, ["-m", which, *deselected, *files], end_s - time.monotonic())
            if code == "no time":
                print(f"{mutation.file}:{mutation.line}: time was over before all tests were tried", file=sys.stderr)
                return ""
            if code not in (0, 5):
                break
        else:
            return ""
    finally:
        (folder / mutation.file).write_text(known_text, encoding="utf-8")
    if not failed or failed in left_out:
        raise RuntimeError(f"pytest ended with {code} and named no test: {mutation}")
    if tested(folder, [failed], 2 * ENDLESS_S)[0] == 0:
        return failed
    print(f"{failed} fails in a copy of the repository, and is left out", file=sys.stderr)
    return killed_by(mutation, folder, end_s - time.monotonic(), (*left_out, failed))


def tested(folder: Path, words: list[str], limit_s: float) -> tuple[int | str, str]:
    """Run tests in a copy of the checkout; return pytest's exit status or "no time", and the test that failed."""
    endless = ("-o", f"faulthandler_timeout={ENDLESS_S}", "-o", "faulthandler_exit_on_timeout=true")
    running = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-x", "-vv", "-rE", "--tb=no", "-p", "no:cacheprovider", *endless, *words],
        cwd=folder,
        env=os.environ
        | {
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONUNBUFFERED": "1",
            "NUMBA_CACHE_DIR": str(folder / ".compiled"),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = running.communicate(timeout=max(limit_s, 1.0))
    except subprocess.TimeoutExpired:
        return "no time", ""
    finally:
        with suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.communicate()
    # One line a test, with its outcome once it has ended; a file that cannot be imported stands in the summary alone.
    about = STOPPED_AT.findall(said)
    return running.returncode, "".join(about[-1]) if about else ""


def copied(folder: Path) -> Path:
    """Return a copy of the checkout in a folder."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.split("\0")[:-1]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, try and print; return 0 where at least nine of ten are killed, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="mutations")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="mutations tried at a time")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds of tests for a mutation")
    parser.add_argument("--results", type=Path, help="file of what was tried: not tried again, and added to")
    parser.add_argument("--again", action="store_true", help="try what survived in the file of results")
    parser.add_argument("--list", action="store_true", help="print the draw and try nothing")
    given = parser.parse_args(argv)
    if given.again and not given.results:
        parser.error("--again needs --results")
    mutations = survivors(given.results) if given.again else drawn(given.count, given.seed)
    if given.list:
        for one in mutations:
            print(f"{one.file}:{one.line}: {one.before}  ->  {one.after}")
        return 0
    known = {} if given.again else {Mutation(**row["mutation"]): row["killed by"] for row in _rows(given.results)}
    with tempfile.TemporaryDirectory() as scratch:
        free: Queue[Path] = Queue()
        for number in range(given.jobs):
            free.put(copied(Path(scratch) / str(number)))

        def tried(mutation: Mutation) -> bool:
            if mutation in known:
                return bool(known[mutation])
            folder = free.get()
            try:
                by = killed_by(mutation, folder, given.limit)
            finally:
                free.put(folder)
            row = json.dumps({"mutation": asdict(mutation), "killed by": by or None})
            print(row, flush=True)
            if given.results:
                with given.results.open("a", encoding="utf-8") as file:
                    file.write(f"{row}\n")
            return bool(by)

        with ThreadPoolExecutor(given.jobs) as pool:
            killed = sum(pool.map(tried, mutations))
    print(json.dumps({"name": "mutations killed", "value": killed, "unit": "", "against": f"{len(mutations)} tried"}))
    return 0 if killed >= 0.9 * len(mutations) else 1


if __name__ == "__main__":
    raise SystemExit(main())
