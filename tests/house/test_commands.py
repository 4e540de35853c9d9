"""Tests of all commands, and of the distribution as a whole."""

from __future__ import annotations

import importlib.metadata
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from croplab import COMMANDS
from experiment.config import LabSettings, load_lab
from foundation.version import PACKAGES

pytestmark = pytest.mark.slow

# Escape sequences for colours (ECMA-48, SGR).
COLOUR = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-7]|4[0-7]|9[0-7]|10[0-7])(?:;\d+)*m")

HEAVY = (
    *("numpy", "numba", "matplotlib", "colour", "rawpy", "cv2", "scipy", "tifffile", "OpenImageIO"),
    *("distributed", "pyarrow", "torch", "zarr"),
)


def test_opening_data_imports_no_command_libraries() -> None:
    code = (
        "import sys, calibration.table.lut, generator\n"
        "generator.open_lut, generator.open_dataset, generator.render\n"
        "print(*sorted({'typer', 'click', 'rich'} & sys.modules.keys()))"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "\n"


def commands_of(command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command and its subcommands with their words."""
    yield (), command
    for name, subcommand in getattr(command, "commands", {}).items():
        for path, command_found in commands_of(subcommand):
            yield (name, *path), command_found


def paths_of(module: str) -> list[tuple[str, ...]]:
    return [path for path, _ in commands_of(get_command(import_module(module).app))]


@pytest.mark.parametrize("command", COMMANDS)
def test_command_is_installed(command: str) -> None:
    entries = importlib.metadata.entry_points(group="console_scripts", name=command)
    (entry,) = set(entries)
    assert entry.value == f"croplab:{command.replace('-', '_')}"
    assert f'_run("{command}")' in inspect.getsource(entry.load())


@pytest.mark.parametrize("module", COMMANDS.values())
def test_unknown_option_is_refused_without_heavy_imports(module: str) -> None:
    code = (
        f"import atexit, runpy, sys\nsys.argv = ['it', '--unknown']\n"
        f"atexit.register(lambda: print('LOADED', *sorted(set({HEAVY!r}) & sys.modules.keys()), file=sys.stderr))\n"
        f"runpy.run_module({module!r}, run_name='__main__')"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert "--unknown" in process.stderr
    assert "Traceback" not in process.stderr
    assert process.stderr.splitlines()[-1] == "LOADED"


@pytest.mark.parametrize(
    ("module", "path"), [(module, path) for module in COMMANDS.values() for path in paths_of(module)], ids=str
)
def test_help_shows_complete_texts(
    module: str, path: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    room = import_module(module)
    monkeypatch.setenv("COLUMNS", "1000")
    assert room.main([*path, "--help"]) == 0
    command, text = dict(commands_of(get_command(room.app)))[path], " ".join(capsys.readouterr().out.split())
    for option in command.params:
        # Rich interprets text in brackets as markup unless a backslash precedes it.
        help_text = (getattr(option, "help", None) or "").replace("\\[", "[")
        assert " ".join(help_text.split()) in text, option.name


def test_internal_error_shows_plain_traceback() -> None:
    module, *other_modules = COMMANDS.values()
    code = (
        f"from {module} import app\n@app.command()\ndef fail():\n    raise ValueError('our mistake')\n"
        "from foundation.console import run\nrun(lambda: app(['fail']))"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert process.returncode == 1
    assert process.stderr.startswith("Traceback (most recent call last):")
    assert process.stderr.endswith("\nValueError: our mistake\n")
    for other_module in other_modules:
        assert not import_module(other_module).app.pretty_exceptions_enable


def test_each_package_has_one_owner() -> None:
    owners = importlib.metadata.packages_distributions()
    assert {room: set(owners[room]) for room in PACKAGES} == {room: {"croplab"} for room in PACKAGES}


def test_obeys_no_color() -> None:
    """https://no-color.org: any value that is not empty; without it there are colours."""
    command_line = [sys.executable, "-m", "acquisition.cli", "--help"]
    for variables, is_coloured in (({}, True), ({"NO_COLOR": "1"}, False)):
        settings = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "TERM")}
        settings |= {"FORCE_COLOR": "1", "TERM": "xterm-256color", **variables}
        output = subprocess.run(command_line, env=settings, capture_output=True, text=True, check=True).stdout
        assert bool(COLOUR.search(output)) == is_coloured


def test_reads_settings_with_byte_order_mark(tmp_path: Path) -> None:
    """Notepad writes the byte order mark of UTF-8."""
    text = 'rig = "simulated"\nchart = "chart.json"\nilluminations = "lights.csv"\n[simulated]\nbody = "Test"\n'
    read: list[LabSettings] = []
    for mark in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "LAB.toml").write_bytes(mark + text.encode())
        read.append(load_lab(tmp_path / "LAB.toml"))
    assert read[0] == read[1]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("evaluation.cli", "cv", "kernel-ridge", "data", "--jobs", "3"), "--workers"),
        (("generator.cli", "demo:", "out", "-j", "3"), "--workers"),
        (("generator.cli", "demo:", "--output", "out"), "OUT is an argument"),
        (("evaluation.cli", "data", "--output", "out"), "--out"),
        (("evaluation.cli", "data", "--metric", "recovery"), "--error"),
        (("sim.cli", "camera", "--body", "Test"), "--model"),
        (("acquisition.cli", "init", "lab", "--paper", "A3"), "--page"),
    ],
)
def test_option_of_other_programs_suggests_ours(
    words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module, *arguments = words
    assert import_module(module).main(arguments) == 2
    assert expected in " ".join(re.sub("[│╭╮╰╯─]", "", capsys.readouterr().err).split())


# Both signals of a quick double Ctrl-C, while modules are imported, and while the command handles the first.
INTERRUPTED = {
    "import": "import signal\nsignal.raise_signal(signal.SIGINT)\nsignal.raise_signal(signal.SIGINT)\n",
    "run": """
import signal
from contextlib import suppress
from foundation.console import orderly_end, run

def command():
    with orderly_end():
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)

def main():
    code = run(command)
    signal.raise_signal(signal.SIGINT)
    return code
""",
}


@pytest.mark.parametrize("phase", INTERRUPTED)
def test_two_interrupts_end_in_one_line(phase: str, tmp_path: Path) -> None:
    (tmp_path / "interrupted.py").write_text(INTERRUPTED[phase])
    code = "import signal, sys, croplab; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code += "; croplab.COMMANDS['sim'] = 'interrupted'; sys.exit(croplab.sim())"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(Path.cwd()), str(tmp_path)))}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, "error: interrupted; run the same command again\n")
