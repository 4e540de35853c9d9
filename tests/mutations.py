"""Draw mutations of the product at random and count those that no test notices.

`python -m tests.mutations [--count 60] [--seed 1] [--results FILE]` changes one place at a time in a copy of the
repository, runs the tests that can reach it, and prints one JSON object a mutation and one for the whole. What is
changed to what are mutmut's operators (an operator, a number, a text, an argument, an assignment, a branch), also on
module level and in decorated functions, where mutmut itself does not go. Every mutation is as likely, so that packages
have their share by size. A mutation is killed where `make test` would fail: a test fails or does not end, and passes
without it, or types do not fit. Which tests run a place is found first, by one run of them all that notes the lines of
each (a quarter of an hour), which is kept in `build/mutations` until the product or the tests change. They are tried
from the quickest on until one fails or `--limit` seconds are over: what survives these, and the checker of types, is
said to survive. `--results` keeps what was tried, so that a run that was stopped goes on; `--again` tries what survived
there once more, wherever its line is now.

Not drawn are annotations, what is raised, and what only type checkers read.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
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
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from queue import Queue
from typing import Any, cast

import libcst as cst
import pytest
from coverage import Coverage, CoverageData
from coverage.data import combine_parallel_data
from libcst.metadata import CodeRange, MetadataWrapper, PositionProvider
from mutmut.mutation.mutators import mutation_operators

ROOT = Path(__file__).parents[1]
PACKAGES: list[str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]
TRACED_INTO = "CROP_TRACED_INTO"
"""Names the folder to a run of pytest that has this file as a plugin, in which it keeps the lines of each test."""

STARTED = """
[run]
parallel = true
sigterm = true
context = ${PYTEST_CURRENT_TEST}
data_file = ${CROP_TRACED_INTO}/lines
source_pkgs = %s
disable_warnings = module-not-imported, no-data-collected, module-not-measured
"""
"""How coverage.py notes the lines of programs that tests start."""

ENDLESS_S = 90
"""Time after which a test is said not to end: half as long again as the slowest takes beside others."""

STOPPED_AT = re.compile(
    r"^(tests/.*?::.*?)(?: <- \S+)?(?: (?:PASSED|SKIPPED|XFAIL|FAILED|ERROR)\b.*| ?)$|^ERROR (tests/[^:\s]*)(?: |$)",
    re.MULTILINE,
)
"""The test at which pytest stopped: it failed, it has no outcome, or its file cannot be imported."""


_AROUND = 30
"""Characters of what stands around a change that are shown."""


@dataclass(frozen=True)
class Mutation:
    """One changed place: its file, relative to the checkout, lines, old and new source.

    `number`: which it is of those of its file. `text`: the line as it stands, by which the place is found again where
    others have moved it.
    """

    file: str
    number: int
    line: int
    last_line: int
    before: str
    after: str
    text: str

    def apply(self, folder: Path) -> str:
        """Change the place in a copy of the checkout and return the file's text as it was."""
        path = folder / self.file
        text = path.read_text(encoding="utf-8")
        places = _Places(text)
        node, changed, _ = places.found[self.number]
        path.write_text(cst.ensure_type(places.module.deep_replace(node, changed), cst.Module).code, encoding="utf-8")
        return text

    def __str__(self) -> str:
        """Return where it is, and what differs with a little of what stands around it."""
        before, after = " ".join(self.before.split()), " ".join(self.after.split())
        start = len(os.path.commonprefix([before, after]))  # noqa: RUF071 - not of paths
        end = len(os.path.commonprefix([before[start:][::-1], after[start:][::-1]]))  # noqa: RUF071
        first = max(start - _AROUND, 0)
        changes = (text[first : len(text) - max(end - _AROUND, 0)] for text in (before, after))
        return f"{self.file}:{self.line}: {'  ->  '.join(changes)}"


class _Places(cst.CSTVisitor):
    """Finds what of a source text may be changed: a node, another one in its place, and where it stands."""

    METADATA_DEPENDENCIES = (PositionProvider,)

    def __init__(self, source: str) -> None:
        super().__init__()
        self.found: list[tuple[cst.CSTNode, cst.CSTNode, CodeRange]] = []
        wrapped = MetadataWrapper(cst.parse_module(source), unsafe_skip_copy=True)
        self.module = wrapped.visit(self)

    def on_visit(self, node: cst.CSTNode) -> bool:
        """Note a node's mutations; return whether to look into it."""
        match node:
            case cst.Annotation() | cst.Raise() | cst.If(test=cst.Name("TYPE_CHECKING")):
                return False
            case _:
                pass
        for kind, operator in mutation_operators:
            for changed in operator(node) if isinstance(node, kind) else ():
                self.found.append((node, changed, cast("CodeRange", self.get_metadata(PositionProvider, node))))
        return True


def places(path: Path) -> Iterator[Mutation]:
    """Yield every mutation of a file."""
    source = path.read_text(encoding="utf-8")
    lines, module = source.splitlines(), cst.Module([])
    for number, (node, changed, place) in enumerate(_Places(source).found):
        yield Mutation(
            str(path.relative_to(ROOT)),
            number,
            place.start.line,
            place.end.line,
            module.code_for_node(node),
            module.code_for_node(changed),
            lines[place.start.line - 1].strip(),
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
        found += sorted(alike, key=lambda one: (abs(one.line - old.line), abs(one.number - old.number)))[:1]
    return found


def _rows(results: Path | None) -> list[dict[str, Any]]:
    """Return what is in a file of results."""
    text = results.read_text(encoding="utf-8") if results and results.exists() else ""
    return [json.loads(line) for line in text.splitlines()]


class Covered:
    """Which lines of the product each test runs, and how long it takes; made once for a state of the product.

    `folder`: where it is kept. Coverage.py sees the lines that the interpreter runs, in the tests' own process and in
    programs that they start: those of compiled functions, and what is run once, on import, are looked for by their
    names.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / "lines").exists():
            _trace(folder)
        self._data = CoverageData(str(folder / "lines"))
        self._data.read()
        self._copy = folder / "copy"
        self.seconds: dict[str, float] = json.loads((folder / "seconds.json").read_text(encoding="utf-8"))

    def tests_of(self, mutation: Mutation) -> list[str]:
        """Return the tests that run a mutation's place, or else what is named there; the quickest first."""
        lines = range(mutation.line, mutation.last_line + 1)
        found = self._running(mutation.file, lines)
        # What runs on import runs in the test that happens to import it first, and is asked of all who use it.
        runs_once = not found or _function_around(mutation.file, mutation.line) is None
        around = _name_around(mutation.file, mutation.line)
        # A constant that nobody names is used by those who go through its module.
        sought = [around if _uses(around) else Path(mutation.file).stem] if runs_once else []
        for name in sought:
            for file, line in _uses(name):
                tests = self._running(file, [line])
                found |= tests
                name_of_use = _function_around(file, line)
                if not tests or name_of_use is None:
                    name_of_use = _name_around(file, line)
                elif all(_function_around(*use) for use in _uses(name_of_use)):
                    continue
                # A function that is called on import is looked for by the name of what it made, too.
                if name_of_use not in sought:
                    sought.append(name_of_use)
        near = f"test_{Path(mutation.file).stem}.py::"
        order = sorted(self.seconds, key=lambda test: self.seconds[test] * (0.3 if near in test else 1.0))
        # What a fixture of a whole file runs is counted for the first test that asks for it.
        files = {test.partition("::")[0] for test in found}
        # What is run on import is also reached by those who look through all names of a module.
        files |= _importers(mutation.file) if runs_once else set()
        mates = [test for test in order if test.partition("::")[0] in files and test not in found]
        return [*(test for test in order if test in found), *mates]

    def _running(self, file: str, lines: Iterable[int]) -> set[str]:
        known = self._lines(file)
        # Programs that a test started name its stage as well: "tests/a.py::test (call)".
        return {test.partition(" (")[0] for line in lines for test in known.get(line, ()) if test} & self.seconds.keys()

    @cache  # noqa: B019 - there is one as long as the program runs
    def _lines(self, file: str) -> dict[int, list[str]]:
        return self._data.contexts_by_lineno(str(self._copy / file))


def _trace(folder: Path) -> None:
    """Run all tests in a copy of the checkout, and keep in a folder which lines each of them ran."""
    shutil.rmtree(folder, ignore_errors=True)
    copy = copied(folder / "copy")
    # Python runs this file as it starts, where it is on its path.
    (copy / "sitecustomize.py").write_text(
        "import os\n\nif 'PYTEST_CURRENT_TEST' in os.environ:\n    import coverage\n\n    coverage.process_startup()\n",
        encoding="utf-8",
    )
    (copy / "started.ini").write_text(STARTED % ", ".join(PACKAGES), encoding="utf-8")
    started = {"COVERAGE_PROCESS_START": str(copy / "started.ini"), TRACED_INTO: str(folder.absolute())}
    plugged = ["-p", "tests.mutations", "-n", "auto", "--dist", "worksteal", "-q"]
    subprocess.run(
        [sys.executable, "-m", "pytest", *plugged, "--tb=no"],
        cwd=copy,
        # Without what it forbids, each worker of pytest would compile every test anew.
        env=_environment(copy) | started | {"PYTHONDONTWRITEBYTECODE": ""},
        stdout=sys.stderr,
        check=False,
    )
    whole = CoverageData(str(folder / "lines"))
    combine_parallel_data(whole)
    shutil.rmtree(copy)


def pytest_configure(config: Any) -> None:
    """Begin to note which lines run, where pytest has this file as a plugin."""
    folder = Path(os.environ[TRACED_INTO])
    measured = Coverage(folder / "lines", data_suffix=True, source_pkgs=PACKAGES, messages=False)
    measured.set_option("run:disable_warnings", ["module-not-imported", "no-data-collected", "module-not-measured"])
    config.pluginmanager.register(_Tracer(measured, folder, hasattr(config, "workerinput")))


class _Tracer:
    """Tells coverage.py which test runs, and notes how long each takes."""

    def __init__(self, measured: Coverage, folder: Path, is_worker: bool) -> None:
        self._measured, self._folder, self._is_worker = measured, folder, is_worker
        self._seconds = dict[str, float]()
        measured.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        self._measured.switch_context(item.nodeid)
        done = yield
        self._measured.switch_context("")
        return done

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] = self._seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        self._measured.stop()
        self._measured.save()
        if not self._is_worker:
            (self._folder / "seconds.json").write_text(json.dumps(self._seconds), encoding="utf-8")


def _digest() -> str:
    """Return a hash of product and tests."""
    digest = hashlib.sha256()
    for folder in (*PACKAGES, "tests"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(f"{path.relative_to(ROOT)}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def _parsed(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text(encoding="utf-8"))


@cache
def _name_around(file: str, line: int) -> str:
    """Return what a line of a file belongs to: a constant, or the innermost function or class."""
    name = ""
    for node in ast.walk(_parsed(file)):
        match node:
            case ast.FunctionDef(name=found) | ast.ClassDef(name=found):
                pass
            case ast.Assign(targets=[ast.Name(id=found), *_]) | ast.AnnAssign(target=ast.Name(id=found)):
                pass
            case _:
                continue
        # What ast.walk comes to later lies further inside.
        if node.lineno <= line <= (node.end_lineno or node.lineno):
            name = found
    return name


@cache
def _function_around(file: str, line: int) -> str | None:
    """Return the innermost function in whose body a line of a file stands."""
    functions = (node for node in ast.walk(_parsed(file)) if isinstance(node, ast.FunctionDef))
    around = [node.name for node in functions if node.body[0].lineno <= line <= (node.end_lineno or node.lineno)]
    return around[-1] if around else None


@cache
def _uses(name: str) -> list[tuple[str, int]]:
    """Return the places, file and line, at which the product uses a name."""
    found: list[tuple[str, int]] = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            file = str(path.relative_to(ROOT))
            for node in ast.walk(_parsed(file)) if name and name in path.read_text(encoding="utf-8") else ():
                match node:
                    case ast.Name(id=used, ctx=ast.Load()) | ast.Attribute(attr=used) if used == name:
                        found.append((file, node.lineno))
                    case _:
                        pass
    return found


def _importers(file: str) -> set[str]:
    """Return the files of tests that import a module."""
    package, _, module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".").rpartition(".")
    taken = re.compile(
        rf"^(?:from {re.escape(package)}\.{module} import|from {re.escape(package)} import .*\b{module}\b)",
        re.MULTILINE,
    )
    found = {str(path.relative_to(ROOT)): path for path in (ROOT / "tests").rglob("test_*.py")}
    return {name for name, path in found.items() if taken.search(path.read_text(encoding="utf-8"))}


def killed_by(
    mutation: Mutation, covered: Covered, folder: Path, limit_s: float, left_out: tuple[str, ...] = ()
) -> str:
    """Return the first test that notices a mutation in a copy of the checkout; "" where none does in the time.

    `left_out`: tests that are not asked, since they fail without it, too, or by chance.
    """
    end_s = time.monotonic() + limit_s
    asked = [test for test in covered.tests_of(mutation) if test not in left_out]
    if not asked:
        print(f"{mutation.file}:{mutation.line}: no test runs it", file=sys.stderr)
        return ""
    (folder / "asked").write_text("\n".join(asked), encoding="utf-8")
    files = dict.fromkeys(test.partition("::")[0] for test in asked)
    known_text = mutation.apply(folder)
    try:
        code, failed = tested(folder, ["@asked"], limit_s)
        if code == pytest.ExitCode.USAGE_ERROR:
            # Cases that are named by what was changed have other names now.
            code, failed = tested(folder, list(files), end_s - time.monotonic())
        if code == "no time":
            print(f"{mutation.file}:{mutation.line}: time was over before all tests were tried", file=sys.stderr)
        if code in ("no time", 0):
            return ""
        # A test that waits may fail once beside others: what notices a change does so each time.
        again = tested(folder, [failed], 2 * ENDLESS_S)[0] if failed else code
    finally:
        (folder / mutation.file).write_text(known_text, encoding="utf-8")
    if code == pytest.ExitCode.USAGE_ERROR and tested(folder, ["--collect-only", *files], 2 * ENDLESS_S)[0] == 0:
        # A conftest cannot be imported any more, which pytest calls wrong usage.
        return "the import of a conftest"
    if not failed or failed in left_out:
        raise RuntimeError(f"pytest ended with {code} and named no test: {mutation}")
    if again != 0 and tested(folder, [failed], 2 * ENDLESS_S)[0] == 0:
        return failed
    print(f"{failed} fails by chance, or in any copy of the repository, and is left out", file=sys.stderr)
    return killed_by(mutation, covered, folder, end_s - time.monotonic(), (*left_out, failed))


def misfits(mutation: Mutation, folder: Path) -> bool:
    """Return whether the checker of types refuses a mutation in a copy of the checkout."""
    known_text = mutation.apply(folder)
    checker = [Path(sys.executable).with_name("pyrefly"), "check", "--threads", "1", "--summary=none"]
    words = [*checker, "--python-interpreter-path", sys.executable]
    try:
        checked = subprocess.run(words, cwd=folder, capture_output=True, check=False)
    finally:
        (folder / mutation.file).write_text(known_text, encoding="utf-8")
    return checked.returncode != 0


def tested(folder: Path, words: list[str], limit_s: float) -> tuple[int | str, str]:
    """Run tests in a copy of the checkout; return pytest's exit status or "no time", and the test that failed."""
    endless = ("-o", f"faulthandler_timeout={ENDLESS_S}", "-o", "faulthandler_exit_on_timeout=true")
    running = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-x", "-vv", "-rE", "--tb=no", "-p", "no:cacheprovider", *endless, *words],
        cwd=folder,
        env=_environment(folder),
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


def _environment(folder: Path) -> dict[str, str]:
    """Return what programs are started with that run in a copy of the checkout."""
    return os.environ | {
        "PYTHONPATH": str(folder),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONUNBUFFERED": "1",
        "NUMBA_CACHE_DIR": str(folder / ".compiled"),
    }


def copied(folder: Path) -> Path:
    """Return a copy of the checkout in a folder, with the data beside it that tests look for there."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.split("\0")[:-1]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    data, beside = ROOT.parent / "shared", folder.parent / "shared"
    if data.is_dir() and not beside.exists():
        beside.symlink_to(data)
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
            print(one)
        return 0
    covered = Covered(ROOT / "build/mutations" / _digest())
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
                by = killed_by(mutation, covered, folder, given.limit) or "types" * misfits(mutation, folder)
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
