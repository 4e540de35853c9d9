"""Count what a reader opens to follow one light through each command, and how large the house is.

`python -m benchmarks.reading [--files] [--size]` prints one JSON object a line for each figure; with `--files`, each
figure is followed by its modules in the order in which they are first needed; with `--size`, packages and tests are
counted in place of that: modules with code, lines, lines of code (no docstrings, comments and blank lines), and how
long functions and lines of code are in the mean. Takes a minute; `--size` a second or two.

What is counted: each command does the same small work twice, the second time with one light (for `generate`: one
picture) more. A module belongs to that light where one of its functions ran more often the second time. Only functions
and methods with a name of their own are counted, no lambda and no comprehension; functions compiled by numba are
counted as those that the interpreter runs. So what runs once a command (reading settings, finding the chart, the
report) is left out, and nothing here knows the name of a module: the figures of two layouts can be compared.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import io
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

import cv2
import numpy as np

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
ROOMS = frozenset[str](PROJECT["tool"]["importlinter"]["root_packages"])
# The same count at commit a3796081, before modules were made deep.
BEFORE = {"acquire run": 94, "acquire run, without the simulated lab": 76, "build-lut": 41, "generate": 40}
# Lines of those modules, at that commit.
LINES_BEFORE = {
    "acquire run": 20906,
    "acquire run, without the simulated lab": 16414,
    "build-lut": 8119,
    "generate": 8163,
}
# Figures of size at that commit.
SIZE_BEFORE = {
    "packages": {"modules": 622, "lines": 111471, "lines of code": 65673, "lines of code a function": 9.2},
    "tests": {"lines": 63836},
}

LAB = """\
rig = "simulated"
chart = "chart/chart.json"
illuminations = "{lights}.csv"
[simulated]
body = "Test"
"""


class Function(NamedTuple):
    """A function of the product: the file, relative to the checkout, its name in it and its first line."""

    file: str
    name: str
    line: int


def function_of(code: CodeType) -> Function | None:
    """Return which function of the product `code` is; None for other software, lambdas and module bodies."""
    path = Path(code.co_filename)
    if code.co_name.startswith("<") or not path.is_relative_to(ROOT):
        return None
    file = path.relative_to(ROOT)
    return Function(str(file), code.co_qualname, code.co_firstlineno) if file.parts[0] in ROOMS else None


class Calls:
    """How often each function of the product was called, in the order of the first calls."""

    def __init__(self) -> None:
        self.counts: Counter[Function] = Counter()
        self._functions: dict[CodeType, Function | None] = {}
        self._compiled: dict[int, tuple[Function, ...]] = {}

    def on_event(self, frame: FrameType, event: str, _: object) -> None:
        """Count a call; what `sys.setprofile` wants."""
        if event != "call":
            return
        code = frame.f_code
        if code not in self._functions:
            self._functions[code] = function_of(code)
        function = self._functions[code]
        if function is not None:
            self.counts[function] += 1

    def on_compiled(self, dispatcher: Any) -> None:
        """Count a call of a compiled function and of those compiled into it."""
        if id(dispatcher) not in self._compiled:
            self._compiled[id(dispatcher)] = compiled_into(dispatcher)
        self.counts.update(self._compiled[id(dispatcher)])


def compiled_into(dispatcher: Any) -> tuple[Function, ...]:
    """Return a compiled function and the compiled functions and intrinsics it names, and so on, each once."""
    found: dict[Function, None] = {}
    waiting, seen = [dispatcher], set[int]()
    while waiting:
        one = waiting.pop()
        # numba keeps the Python function of a dispatcher as py_func and that of an intrinsic as _defn.
        source = getattr(one, "py_func", None) or getattr(one, "_defn", None)
        if source is None or id(one) in seen:
            continue
        seen.add(id(one))
        # That of a step in LLVM's terms is made by a decorator from what writes it.
        source = inspect.unwrap(source)
        function = function_of(source.__code__)
        if function is not None:
            found[function] = None
        waiting.extend(source.__globals__.get(name) for name in names_in(source.__code__))
    return tuple(found)


def names_in(code: CodeType) -> Iterable[str]:
    """Yield the global names that a function and those inside it use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from names_in(constant)


def trace(command: str, arguments: Sequence[str], out: Path) -> int:
    """Run a console command in this process, save how often each function was called, and return its exit code."""
    calls = Calls()
    module, name = PROJECT["project"]["scripts"][command].split(":")
    registry: Any = importlib.import_module("numba.core.registry")
    original = registry.CPUDispatcher.__call__

    def counted(dispatcher: Any, *given: Any, **named: Any) -> Any:
        calls.on_compiled(dispatcher)
        return original(dispatcher, *given, **named)

    registry.CPUDispatcher.__call__ = counted
    main = getattr(importlib.import_module(module), name)
    sys.argv = [command, *arguments]
    threading.setprofile(calls.on_event)
    sys.setprofile(calls.on_event)
    try:
        code = main()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    out.write_text(json.dumps([[*function, count] for function, count in calls.counts.items()]), encoding="utf-8")
    return int(code or 0)


def called(folder: Path, command: str, *arguments: str) -> dict[Function, int]:
    """Run a command in a process of its own in `folder`; return how often each function was called."""
    out = folder / "calls.json"
    line = [sys.executable, "-m", "benchmarks.reading", "--trace", str(out), command, *arguments]
    # The command runs in `folder`; this file and the product are found in the checkout all the same.
    search = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, cwd=folder, env=search, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{command} {' '.join(arguments)} ended with {done.returncode}: {done.stderr}")
    return {Function(*row[:3]): row[3] for row in json.loads(out.read_text(encoding="utf-8"))}


def opened(fewer: Mapping[Function, int], more: Mapping[Function, int]) -> list[str]:
    """Return the files of the functions that were called more often, in the order of their first calls."""
    return list(dict.fromkeys(function.file for function, count in more.items() if count > fewer.get(function, 0)))


def save_picture(path: Path, seed: int) -> None:
    """Save a picture of 96 × 64 random pixels."""
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 256, (64, 96, 3), dtype=np.uint8))


def measure(folder: Path) -> dict[str, list[str]]:
    """Return the modules opened for one light of each command, in order."""
    found: dict[str, list[str]] = {}
    called(folder, "acquire", "chart", "chart", "--bits", "2", "--no-tiff")
    for lights, kelvins in (("fewer", "2500:7500:2500"), ("more", "2500:10000:2500")):
        called(folder, "acquire", "illuminations", f"{lights}.csv", "--grid", "1", "--blackbodies", kelvins)
        (folder / f"{lights}.toml").write_text(LAB.format(lights=lights), encoding="utf-8")
    for number in range(3):
        save_picture(folder / "more_pictures" / f"{number}.png", number)
    for number in range(2):
        save_picture(folder / "fewer_pictures" / f"{number}.png", number)
    for command, arguments in (
        ("acquire", ("run", "{}.toml", "{}_session")),
        ("build-lut", ("{}_session", "{}_lut")),
        # The smaller run of each pair comes first, so that what is compiled and kept is not counted for the larger.
        # One thread, since with several it is chance who waits for whom.
        ("generate", ("more_lut", "{}_dataset", "--sources", "{}_pictures", "--workers", "1")),
    ):
        fewer = called(folder, command, *(argument.format("fewer") for argument in arguments))
        more = called(folder, command, *(argument.format("more") for argument in arguments))
        found["acquire run" if command == "acquire" else command] = opened(fewer, more)
    return found


def code_lines(text: str, tree: ast.Module) -> set[int]:
    """Return the numbers of the lines that hold code: no docstring, comment or blank line."""
    skipped = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in skipped:
            found |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                found -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
            case _:
                pass
    return found


def size(folders: Iterable[str]) -> dict[str, float]:
    """Return how large the Python files below folders are, figure by figure."""
    modules, lines, code = 0, 0, 0
    functions, lengths = list[int](), list[int]()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        rows, own = text.splitlines(), code_lines(text, tree)
        modules, lines, code = modules + bool(own), lines + len(rows), code + len(own)
        lengths += [len(rows[number - 1]) for number in own]
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                functions.append(len(own.intersection(range(node.lineno, (node.end_lineno or node.lineno) + 1))))
    return {
        "modules": modules,
        "lines": lines,
        "lines of code": code,
        "lines of code a function": round(statistics.mean(functions or [0]), 2),
        "characters a line of code": round(statistics.mean(lengths or [0]), 1),
    }


def print_size() -> None:
    """Print how large the packages, each of them, and the tests are."""
    groups = {"packages": sorted(ROOMS), **{room: [room] for room in sorted(ROOMS)}, "tests": ["tests"]}
    for group, folders in groups.items():
        for name, value in size(folders).items():
            before = SIZE_BEFORE.get(group, {}).get(name)
            against = {} if before is None else {"against": f"{before} before modules were made deep"}
            print(json.dumps({"name": f"{name}: {group}", "value": value, "unit": "", **against}), flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Count and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", action="store_true", help="list the modules, too")
    parser.add_argument("--size", action="store_true", help="count the house in place of ways through it")
    parser.add_argument("--trace", type=Path, metavar="OUT", help=argparse.SUPPRESS)
    parser.add_argument("command", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    if given.trace is not None:
        return trace(given.command[0], given.command[1:], given.trace)
    if given.size:
        print_size()
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        found = measure(Path(scratch))
    files = found["acquire run"]
    found["acquire run, without the simulated lab"] = [file for file in files if Path(file).parts[0] != "sim"]
    for name, files in found.items():
        figure = {"name": f"modules opened to follow one light: {name}", "value": len(files), "unit": "modules"}
        print(json.dumps(figure | {"against": f"{BEFORE[name]} before modules were made deep"}), flush=True)
        lines = sum(len((ROOT / file).read_text(encoding="utf-8").splitlines()) for file in files)
        figure = {"name": f"lines of these modules: {name}", "value": lines, "unit": "lines"}
        print(json.dumps(figure | {"against": f"{LINES_BEFORE[name]} before"}), flush=True)
        if given.files:
            print(*(f"  {file}" for file in files), sep="\n", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
