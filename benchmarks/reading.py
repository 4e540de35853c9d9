"""Count the modules that one illuminant passes in each command, and the size of the code.

`python -m benchmarks.reading [--files] [--size]` prints one JSON object per result and line. `--files` lists the
modules of each command in the order of first use. `--size` counts the code of packages and tests instead: modules with
code, lines, lines of code (no docstrings, comments and blank lines), and the mean length of functions and lines. The
benchmark takes a minute, with `--size` a second or two.

Each command does the same small work twice, the second time with one more illuminant (`generate`: one more picture). A
module counts if one of its functions ran more often in the second call. Work that happens once per command (settings,
registration, the report) is therefore excluded. Only named functions and methods count, not lambdas and comprehensions.
Functions compiled by numba count like other functions. The benchmark does not depend on module names, so that different
layouts of the code can be compared.
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
# Counts at commit a3796081, before small modules were merged.
BEFORE = {"acquire run": 94, "acquire run, without the simulated lab": 76, "build-lut": 41, "generate": 40}
# Lines of these modules at that commit.
LINES_BEFORE = {
    "acquire run": 20906,
    "acquire run, without the simulated lab": 16414,
    "build-lut": 8119,
    "generate": 8163,
}
# Size figures at that commit.
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
    """A function of the product: file relative to the checkout, qualified name, first line."""

    file: str
    name: str
    line: int


def function_of(code: CodeType) -> Function | None:
    """Return the function of `code`; None for other software, lambdas and module bodies."""
    path = Path(code.co_filename)
    if code.co_name.startswith("<") or not path.is_relative_to(ROOT):
        return None
    file = path.relative_to(ROOT)
    return Function(str(file), code.co_qualname, code.co_firstlineno) if file.parts[0] in ROOMS else None


class Calls:
    """Number of calls of each product function, in the order of first calls."""

    def __init__(self) -> None:
        self.counts: Counter[Function] = Counter()
        self._functions: dict[CodeType, Function | None] = {}
        self._compiled: dict[int, tuple[Function, ...]] = {}

    def on_event(self, frame: FrameType, event: str, _: object) -> None:
        """Count a call; this is the callback for `sys.setprofile`."""
        if event != "call":
            return
        code = frame.f_code
        if code not in self._functions:
            self._functions[code] = function_of(code)
        function = self._functions[code]
        if function is not None:
            self.counts[function] += 1

    def on_compiled(self, dispatcher: Any) -> None:
        """Count a call of a compiled function and of the functions compiled into it."""
        if id(dispatcher) not in self._compiled:
            self._compiled[id(dispatcher)] = compiled_into(dispatcher)
        self.counts.update(self._compiled[id(dispatcher)])


def compiled_into(dispatcher: Any) -> tuple[Function, ...]:
    """Return a compiled function and all compiled functions and intrinsics that it uses, each once."""
    functions: dict[Function, None] = {}
    queue, visited = [dispatcher], set[int]()
    while queue:
        dispatcher_or_intrinsic = queue.pop()
        # numba keeps the Python function of a dispatcher as py_func and that of an intrinsic as _defn.
        source = getattr(dispatcher_or_intrinsic, "py_func", None) or getattr(dispatcher_or_intrinsic, "_defn", None)
        if source is None or id(dispatcher_or_intrinsic) in visited:
            continue
        visited.add(id(dispatcher_or_intrinsic))
        # The function of an intrinsic is made by a decorator; unwrap it.
        source = inspect.unwrap(source)
        function = function_of(source.__code__)
        if function is not None:
            functions[function] = None
        queue.extend(source.__globals__.get(name) for name in names_in(source.__code__))
    return tuple(functions)


def names_in(code: CodeType) -> Iterable[str]:
    """Yield the global names used by a function and its inner functions."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from names_in(constant)


def trace(command: str, arguments: Sequence[str], out: Path) -> int:
    """Run a console command in this process, save the number of calls per function and return the exit code."""
    calls = Calls()
    module, name = PROJECT["project"]["scripts"][command].split(":")
    registry: Any = importlib.import_module("numba.core.registry")
    original = registry.CPUDispatcher.__call__

    def counted(dispatcher: Any, *arguments: Any, **options: Any) -> Any:
        calls.on_compiled(dispatcher)
        return original(dispatcher, *arguments, **options)

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
    """Run a command in a separate process in `folder`; return the calls per function."""
    out = folder / "calls.json"
    command_line = [sys.executable, "-m", "benchmarks.reading", "--trace", str(out), command, *arguments]
    # The command runs in `folder`, so this module and the product must be on the path.
    search = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.run(command_line, cwd=folder, env=search, capture_output=True, text=True, check=False)
    if process.returncode:
        raise RuntimeError(
            f"{command} {' '.join(arguments)} ended with exit code {process.returncode}, 0 expected: {process.stderr}"
        )
    return {Function(*row[:3]): row[3] for row in json.loads(out.read_text(encoding="utf-8"))}


def opened(base_calls: Mapping[Function, int], larger_calls: Mapping[Function, int]) -> list[str]:
    """Return the files of functions that were called more often, in the order of first calls."""
    return list(
        dict.fromkeys(function.file for function, count in larger_calls.items() if count > base_calls.get(function, 0))
    )


def save_picture(path: Path, seed: int) -> None:
    """Save a picture of 96 × 64 random pixels."""
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 256, (64, 96, 3), dtype=np.uint8))


def measure(folder: Path) -> dict[str, list[str]]:
    """Return the modules used for one more illuminant in each command, in order."""
    modules_by_command: dict[str, list[str]] = {}
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
        # The smaller run comes first, so that compilation and caching do not count for the larger run. There is one
        # worker, because with several workers it is random which worker waits.
        ("generate", ("more_lut", "{}_dataset", "--sources", "{}_pictures", "--workers", "1")),
    ):
        base_calls = called(folder, command, *(argument.format("fewer") for argument in arguments))
        larger_calls = called(folder, command, *(argument.format("more") for argument in arguments))
        modules_by_command["acquire run" if command == "acquire" else command] = opened(base_calls, larger_calls)
    return modules_by_command


def code_lines(text: str, tree: ast.Module) -> set[int]:
    """Return the numbers of the lines with code: no docstring, comment or blank line."""
    skipped = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    line_numbers: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in skipped:
            line_numbers |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                line_numbers -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
            case _:
                pass
    return line_numbers


def size(folders: Iterable[str]) -> dict[str, float]:
    """Return the size figures of the Python files in folders."""
    modules, lines, code = 0, 0, 0
    functions, lengths = list[int](), list[int]()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        rows, code_rows = text.splitlines(), code_lines(text, tree)
        modules, lines, code = modules + bool(code_rows), lines + len(rows), code + len(code_rows)
        lengths += [len(rows[number - 1]) for number in code_rows]
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                functions.append(len(code_rows.intersection(range(node.lineno, (node.end_lineno or node.lineno) + 1))))
    return {
        "modules": modules,
        "lines": lines,
        "lines of code": code,
        "lines of code a function": round(statistics.mean(functions or [0]), 2),
        "characters a line of code": round(statistics.mean(lengths or [0]), 1),
    }


def print_size() -> None:
    """Print the size figures of all packages, of each package, and of the tests."""
    groups = {"packages": sorted(ROOMS), **{room: [room] for room in sorted(ROOMS)}, "tests": ["tests"]}
    for group, folders in groups.items():
        for name, value in size(folders).items():
            old_value = SIZE_BEFORE.get(group, {}).get(name)
            against = {} if old_value is None else {"against": f"{old_value} before small modules were merged"}
            print(json.dumps({"name": f"{name}: {group}", "value": value, "unit": "", **against}), flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Count and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", action="store_true", help="also list the modules")
    parser.add_argument("--size", action="store_true", help="print the size of the code instead")
    parser.add_argument("--trace", type=Path, metavar="OUT", help=argparse.SUPPRESS)
    parser.add_argument("command", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.trace is not None:
        return trace(options.command[0], options.command[1:], options.trace)
    if options.size:
        print_size()
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        modules = measure(Path(scratch))
    files = modules["acquire run"]
    modules["acquire run, without the simulated lab"] = [file for file in files if Path(file).parts[0] != "sim"]
    for name, files in modules.items():
        figure = {"name": f"modules used for one illuminant: {name}", "value": len(files), "unit": "modules"}
        print(json.dumps(figure | {"against": f"{BEFORE[name]} before small modules were merged"}), flush=True)
        lines = sum(len((ROOT / file).read_text(encoding="utf-8").splitlines()) for file in files)
        figure = {"name": f"lines of these modules: {name}", "value": lines, "unit": "lines"}
        print(json.dumps(figure | {"against": f"{LINES_BEFORE[name]} before"}), flush=True)
        if options.files:
            print(*(f"  {file}" for file in files), sep="\n", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
