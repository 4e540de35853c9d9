"""Draw random mutations of the product and count those that no test notices.

`python -m tests.mutations [--count 60] [--seed 1]` changes one place at a time in a copy of the repository, runs the
tests that reach it, and prints one JSON object for each mutation and one for the total. The changes are mutmut's
operators, applied also on module level and in decorated functions. Each place is equally likely. A mutation is noticed
if a test fails that passes without it, or if the type checker refuses it.

The tests of a place in a function are those that run its line, then the others in their files. A place outside
functions runs once, at import, and the first test that imports the module says nothing about its use. For such a place,
and if no test runs the line (compiled functions), the tests are those that run any line of its module, or of a module
that imports it. One run of all
tests finds these lines (a quarter of an hour); it is kept in `build/mutations` until product or tests change.
Annotations and raised exceptions are not changed.
"""

from __future__ import annotations

import argparse
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
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
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
LINES_FOLDER = "CROP_LINES_FOLDER"  # where pytest, with this file as a plugin, keeps the lines of each test
ENDLESS_S = 90  # a test that takes longer counts as failed; the slowest takes 60 s beside others

# Settings with which coverage.py records the lines of programs started by tests.
SUBPROCESSES = """
[run]
parallel = true
sigterm = true
context = ${PYTEST_CURRENT_TEST}
data_file = ${CROP_LINES_FOLDER}/lines
source_pkgs = %s
disable_warnings = module-not-imported, no-data-collected, module-not-measured
"""
# Python runs this file at its start if it is on the path.
SITECUSTOMIZE = """
import os

if "PYTEST_CURRENT_TEST" in os.environ:
    import coverage

    coverage.process_startup()
"""
# The test at which pytest stopped: one line a test in the verbose output, or an import error in the summary.
STOPPED_AT = re.compile(
    r"^(tests/.*?::.*?)(?: <- \S+)?(?: (?:PASSED|SKIPPED|XFAIL|FAILED|ERROR)\b.*| ?)$|^ERROR (tests/[^:\s]*)(?: |$)",
    re.MULTILINE,
)


@dataclass(frozen=True)
class Mutation:
    """A changed place: file, number in the file, lines, old and new source."""

    file: str
    number: int
    line: int
    last_line: int
    before: str
    after: str
    is_in_function: bool

    @contextmanager
    def applied(self, folder: Path) -> Generator[None]:
        """Change the place in a copy of the repository, and change it back."""
        path = folder / self.file
        text = path.read_text(encoding="utf-8")
        visitor = _Places(text)
        node, changed, _, _ = visitor.places[self.number]
        path.write_text(cst.ensure_type(visitor.module.deep_replace(node, changed), cst.Module).code, encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(text, encoding="utf-8")


class _Places(cst.CSTVisitor):
    """The places of a source text: old node, new node, position, whether it is in the body of a function."""

    METADATA_DEPENDENCIES = (PositionProvider,)

    def __init__(self, source: str) -> None:
        super().__init__()
        self.places: list[tuple[cst.CSTNode, cst.CSTNode, CodeRange, bool]] = []
        self._depth = 0  # functions around the node
        self.module = MetadataWrapper(cst.parse_module(source), unsafe_skip_copy=True).visit(self)

    def on_visit(self, node: cst.CSTNode) -> bool:
        match node:
            case cst.Annotation() | cst.Raise() | cst.If(test=cst.Name("TYPE_CHECKING")):
                return False
            case _:
                pass
        for kind, operator in mutation_operators:
            for changed in operator(node) if isinstance(node, kind) else ():
                position = cast("CodeRange", self.get_metadata(PositionProvider, node))
                self.places.append((node, changed, position, self._depth > 0))
        return True

    def on_visit_attribute(self, node: cst.CSTNode, attribute: str) -> None:
        self._depth += isinstance(node, cst.FunctionDef) and attribute == "body"

    def on_leave_attribute(self, original_node: cst.CSTNode, attribute: str) -> None:
        self._depth -= isinstance(original_node, cst.FunctionDef) and attribute == "body"


def mutations_of(path: Path) -> Iterator[Mutation]:
    code = cst.Module([]).code_for_node
    places = _Places(path.read_text(encoding="utf-8")).places
    for number, (node, changed, position, is_in_function) in enumerate(places):
        lines = position.start.line, position.end.line
        yield Mutation(path.relative_to(ROOT).as_posix(), number, *lines, code(node), code(changed), is_in_function)


def draw_mutations(count: int, seed: int, packages: Sequence[str]) -> list[Mutation]:
    paths = [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]
    return random.Random(seed).sample([mutation for path in paths for mutation in mutations_of(path)], count)


class Covered:
    """The lines that each test runs, and the seconds that it takes."""

    def __init__(self, folder: Path, tests: Sequence[str]) -> None:
        if not (folder / "lines").exists():
            _trace(folder, tests)
        self._data = CoverageData(str(folder / "lines"))
        self._data.read()
        self._copy = folder / "copy"
        self.seconds: dict[str, float] = json.loads((folder / "seconds.json").read_text(encoding="utf-8"))

    def tests_of(self, mutation: Mutation) -> list[str]:
        """Return the tests of a place, the quickest first."""
        lines = self._lines(mutation.file)
        place_lines = range(mutation.line, mutation.last_line + 1) if mutation.is_in_function else ()
        places = {test for line in place_lines for test in lines.get(line, ())}
        for file in () if places else (mutation.file, *_importers(mutation.file)):
            places |= {test for tests in self._lines(file).values() for test in tests}
        # A shared fixture counts for the first test that uses it.
        files = {test.partition("::")[0] for test in places}
        near = f"test_{Path(mutation.file).stem}.py::"
        order = sorted(self.seconds, key=lambda test: self.seconds[test] * (0.3 if near in test else 1.0))
        mates = [test for test in order if test not in places and test.partition("::")[0] in files]
        return [*(test for test in order if test in places), *mates]

    def _lines(self, file: str) -> dict[int, set[str]]:
        # Programs name the phase of the test as well: "tests/a.py::test (call)".
        contexts = self._data.contexts_by_lineno(str(self._copy / file))
        return {
            line: {name.partition(" (")[0] for name in tests_of_line} & self.seconds.keys()
            for line, tests_of_line in contexts.items()
        }


def _importers(file: str) -> list[str]:
    """Return the files of the product that import a module."""
    package, _, name = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".").rpartition(".")
    imported = re.compile(rf"^\s*(?:from {package}\.{name} import|from {package} import .*\b{name}\b)", re.MULTILINE)
    paths = [path for package_name in PACKAGES for path in sorted((ROOT / package_name).rglob("*.py"))]
    return [path.relative_to(ROOT).as_posix() for path in paths if imported.search(path.read_text(encoding="utf-8"))]


def _trace(folder: Path, tests: Sequence[str]) -> None:
    """Run all tests in a copy of the repository and keep the lines that each of them ran."""
    shutil.rmtree(folder, ignore_errors=True)
    copy = copy_repository(folder / "copy")
    (copy / "sitecustomize.py").write_text(SITECUSTOMIZE, encoding="utf-8")
    (copy / "started.ini").write_text(SUBPROCESSES % ", ".join(PACKAGES), encoding="utf-8")
    words = ["-p", "tests.mutations", "-n", "auto", "--dist", "worksteal", "-q", "--tb=no", *tests]
    started = {"COVERAGE_PROCESS_START": str(copy / "started.ini"), LINES_FOLDER: str(folder.absolute())}
    # With PYTHONDONTWRITEBYTECODE each worker of pytest would compile every test again.
    environment = _environment(copy) | started | {"PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run([sys.executable, "-m", "pytest", *words], cwd=copy, env=environment, stdout=sys.stderr, check=False)
    combine_parallel_data(CoverageData(str(folder / "lines")))
    shutil.rmtree(copy)


def pytest_configure(config: Any) -> None:
    """Record lines, if pytest has this file as a plugin."""
    folder = Path(os.environ[LINES_FOLDER])
    measured = Coverage(folder / "lines", data_suffix=True, source_pkgs=PACKAGES, messages=False)
    measured.set_option("run:disable_warnings", ["module-not-imported", "no-data-collected", "module-not-measured"])
    config.pluginmanager.register(_Tracer(measured, folder, hasattr(config, "workerinput")))


class _Tracer:
    def __init__(self, measured: Coverage, folder: Path, is_worker: bool) -> None:
        self._measured, self._folder, self._is_worker = measured, folder, is_worker
        self._seconds = dict[str, float]()
        measured.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        self._measured.switch_context(item.nodeid)
        result = yield
        self._measured.switch_context("")
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] = self._seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        self._measured.stop()
        self._measured.save()
        if not self._is_worker:
            (self._folder / "seconds.json").write_text(json.dumps(self._seconds), encoding="utf-8")


def noticed_by(mutation: Mutation, covered: Covered, folder: Path, limit_s: float) -> str:
    """Return the first test that notices a mutation within a time, "types", or ""."""
    end_s = time.monotonic() + limit_s
    candidates = covered.tests_of(mutation)
    while candidates:
        (folder / "candidates").write_text("\n".join(candidates), encoding="utf-8")
        with mutation.applied(folder):
            code, failed = run_tests(folder, ["@candidates"], end_s - time.monotonic())
            if code == pytest.ExitCode.USAGE_ERROR:
                # The mutation renamed cases of a test, or a conftest cannot be imported.
                files = list(dict.fromkeys(test.partition("::")[0] for test in candidates))
                code, failed = run_tests(folder, files, end_s - time.monotonic())
        if code in (0, None):
            break
        if not failed or run_tests(folder, [failed], 2 * ENDLESS_S)[0] == 0:
            return failed or "pytest"
        # It fails without the mutation as well.
        candidates = [test for test in candidates if test != failed]
    with mutation.applied(folder):
        return "" if has_types_that_fit(folder) else "types"


def has_types_that_fit(folder: Path) -> bool:
    words = [str(Path(sys.executable).with_name("pyrefly")), "check", "--threads", "1", "--summary=none"]
    words += ["--python-interpreter-path", sys.executable]
    return subprocess.run(words, cwd=folder, capture_output=True, check=False).returncode == 0


def run_tests(folder: Path, words: Sequence[str], limit_s: float) -> tuple[int | None, str]:
    """Run tests in a copy of the repository; return pytest's exit code, None if time ran out, and the failed test."""
    time_limit = ("-o", f"faulthandler_timeout={ENDLESS_S}", "-o", "faulthandler_exit_on_timeout=true")
    running = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-x", "-vv", "-rE", "--tb=no", "-p", "no:cacheprovider", *time_limit, *words],
        cwd=folder,
        env=_environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = running.communicate(timeout=max(limit_s, 1.0))
    except subprocess.TimeoutExpired:
        return None, ""
    finally:
        with suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.communicate()
    stopped = STOPPED_AT.findall(output)
    return running.returncode, "".join(stopped[-1]) if stopped else ""


def _environment(folder: Path) -> dict[str, str]:
    settings = {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": "1"}
    return os.environ | settings | {"NUMBA_CACHE_DIR": str(folder / ".compiled")}


def copy_repository(folder: Path) -> Path:
    """Copy the repository into a folder, and link the data beside it."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.split("\0")[:-1]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    data, link = ROOT.parent / "shared", folder.parent / "shared"
    if data.is_dir() and not link.exists():
        link.symlink_to(data)
    return folder


def _digest(tests: Sequence[str]) -> str:
    digest = hashlib.sha256(" ".join(tests).encode())
    for folder in (*PACKAGES, "tests"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, try and print; return 0 if at least nine of ten are noticed, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="number of mutations")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="mutations tried at a time")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds of tests for a mutation")
    parser.add_argument("--packages", nargs="+", default=PACKAGES, help="packages to mutate")
    parser.add_argument("--tests", nargs="+", default=["tests"], help="files or folders of tests")
    options = parser.parse_args(argv)
    mutations = draw_mutations(options.count, options.seed, options.packages)
    covered = Covered(ROOT / "build/mutations" / _digest(options.tests), options.tests)
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(options.jobs) as pool:
        free_folders: Queue[Path] = Queue()
        for number in range(options.jobs):
            free_folders.put(copy_repository(Path(scratch) / str(number)))
        if not has_types_that_fit(Path(scratch) / "0"):
            raise SystemExit("pyrefly reports errors in the unchanged repository; correct them first")

        def try_mutation(mutation: Mutation) -> bool:
            folder = free_folders.get()
            try:
                test = noticed_by(mutation, covered, folder, options.limit)
            finally:
                free_folders.put(folder)
            print(json.dumps({"mutation": asdict(mutation), "noticed by": test or None}), flush=True)
            return bool(test)

        noticed = sum(pool.map(try_mutation, mutations))
    print(json.dumps({"name": "mutations noticed", "value": noticed, "unit": "", "against": f"{len(mutations)} tried"}))
    return 0 if noticed >= 0.9 * len(mutations) else 1


if __name__ == "__main__":
    raise SystemExit(main())
