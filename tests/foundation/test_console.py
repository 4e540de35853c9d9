"""Exit codes, error lines, signals and common options of commands."""

from __future__ import annotations

import errno
import io
import logging
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from foundation import errors
from foundation.console import (
    EndRequest,
    new_app,
    orderly_end,
    progress,
    run,
    shows_progress,
)
from foundation.errors import FormatError


def failing(error: BaseException) -> Callable[[], None]:
    """Return a command that raises an error."""

    def fail() -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "problem", "waiting"),
    [
        (errors.LinkClosed("gone; check its cable", about="camera"), "camera: gone", "camera: gone; check its cable"),
        (errors.LinkClosed("gone: a; b", remedy="mend it"), "gone: a; b", "gone: a; b; mend it"),
        (errors.StorageError(f"full; free space, {errors.RUN_AGAIN}"), "full", "full; free space"),
        (errors.StorageError("full", remedy=f"free space; {errors.RUN_AGAIN}"), "full", "full; free space"),
        (errors.StorageError("full", remedy=errors.RUN_AGAIN), "full", "full"),
        (errors.DeviceError("run the same command again, it said"), *["run the same command again, it said"] * 2),
    ],
)
def test_error_has_its_remedy_as_attribute(error: errors.CropError, problem: str, waiting: str) -> None:
    assert error.without_remedy() == problem
    assert error.while_waiting() == waiting
    assert str(error).startswith(waiting)
    restored = pickle.loads(pickle.dumps(error))
    assert (str(restored), restored.remedy) == (str(error), error.remedy)


# The tree in the docstring of foundation.errors.
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.InputError, 2),
        (errors.ConfigurationError, 2),
        (errors.FormatError, 2),
        (errors.DeviceError, 3),
        (errors.LinkError, 3),
        (errors.LinkTimeout, 3),
        (errors.LinkClosed, 3),
        (errors.ProtocolError, 3),
        (errors.DeviceRefused, 3),
        (errors.DeviceFault, 3),
        (errors.QualityError, 4),
        (errors.RegistrationError, 4),
        (errors.StorageError, 5),
    ],
)
def test_each_error_has_a_code(error: type[errors.CropError], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(failing(error("lab.toml: shutter_s is -1, more than 0 was expected; correct it"))) == code
    assert capsys.readouterr() == ("", "error: lab.toml: shutter_s is -1, more than 0 was expected; correct it\n")


def test_interruption_exits_with_130(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    assert run(interrupt) == 130
    assert capsys.readouterr().err == "error: interrupted; run the same command again\n"

    def interrupt_wrapped() -> None:
        try:
            interrupt()
        except KeyboardInterrupt as error:
            raise RuntimeError("Error calling __set_name__") from error

    assert run(interrupt_wrapped) == 130
    assert capsys.readouterr().err == "error: interrupted; run the same command again\n"
    assert run(interrupt, is_resumable=False) == 130
    assert capsys.readouterr().err == "error: interrupted; no results were kept\n"


@pytest.mark.parametrize(
    ("number", "beginning"),
    [
        (errno.ENOSPC, "cannot write /disk/samples.npy: No space left on device; free space or"),
        (errno.EIO, "cannot use /disk/samples.npy: Input/output error; the disk fails: read the output of dmesg"),
    ],
)
def test_disk_error_exits_with_5(number: int, beginning: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(failing(OSError(number, os.strerror(number), "/disk/samples.npy"))) == 5
    line = capsys.readouterr().err
    assert line.startswith(f"error: {beginning}")
    assert line.endswith("then run the same command again\n")


@pytest.mark.parametrize("name", ["/theirs/dataset.json", b"/theirs/dataset.json"])
@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EACCES, "ask its owner for permission, or choose another path"),
        (errno.EPERM, "ask its owner for permission, or choose another path"),
        (errno.EISDIR, "it is a folder; give a file"),
        (errno.ENOTDIR, "a part of that path is a file, not a folder; choose another path"),
        (errno.ENAMETOOLONG, "choose a shorter name"),
        (errno.ELOOP, "its links form a circle; give the path without links"),
    ],
)
def test_unusable_path_exits_with_2(
    number: int, remedy: str, name: str | bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(failing(OSError(number, os.strerror(number), name))) == 2
    assert capsys.readouterr().err == f"error: cannot use /theirs/dataset.json: {os.strerror(number)}; {remedy}\n"


@pytest.mark.parametrize(
    ("error", "reason"),
    [(MemoryError(), "all is used"), (MemoryError("Unable to allocate 9 TiB"), "Unable to allocate 9 TiB")],
)
def test_missing_memory_exits_with_2(error: MemoryError, reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(failing(error)) == 2
    assert capsys.readouterr().err == (
        f"error: not enough memory ({reason}); use fewer --workers, or smaller pictures\n"
    )


def ended(program: str, output: int) -> tuple[int, str]:
    """Return exit code and stderr of a program whose stdout is `output`."""
    # Buffered, as a user has it, whatever the surroundings of this test.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    text = f"from foundation.console import run\nimport sys\n{program}"
    result = subprocess.run(
        [sys.executable, "-c", text],
        stdout=output,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=60,
        env=environment,
    )
    return result.returncode, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [
        "raise SystemExit(run(lambda: [print('x' * 99) for _ in range(10_000)]))",
        "raise SystemExit(run(lambda: print('one line, still in the buffer when the command is done')))",
        "raise SystemExit(run(lambda: (print('as typer does'), sys.exit(0))))",
    ],
)
def test_closed_reader_is_no_error(program: str) -> None:
    pipe = subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE)
    with pipe:
        assert pipe.stdin is not None
        pipe.wait()
        assert ended(program, pipe.stdin.fileno()) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("lines", [1, 10_000])
def test_full_output_device_exits_with_5(lines: int) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with full.open("wb") as stream:
        code, error = ended(f"raise SystemExit(run(lambda: [print('x') for _ in range({lines})]))", stream.fileno())
    assert code == 5
    assert error.startswith("error: cannot ")
    assert "No space left" in error
    assert error.count("\n") == 1
    assert "cannot write standard output: " in error or "cannot print: " in error


@pytest.mark.usefixtures("hang_up")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_ignored_hang_up_stays_ignored(number: int) -> None:
    """As under nohup."""
    previous = signal.signal(number, signal.SIG_IGN)
    try:
        with orderly_end():
            signal.raise_signal(number)
        assert signal.getsignal(number) == signal.SIG_IGN
    finally:
        signal.signal(number, previous)


@pytest.mark.usefixtures("hang_up")
def test_closed_terminal_exits_as_interrupted() -> None:
    def draw() -> None:
        raise OSError(errno.EIO, "Input/output error")

    def hang_up() -> None:
        with orderly_end(), ExitStack() as stack:
            stack.callback(draw)
            signal.raise_signal(signal.SIGHUP)

    with pytest.raises(KeyboardInterrupt):
        hang_up()
    with pytest.raises(OSError, match="Input/output error"), orderly_end():
        draw()


def test_closed_stderr_keeps_the_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone(io.StringIO):
        def write(self, text: str, /) -> int:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(sys, "stderr", Gone())
    assert run(failing(errors.InputError("no such lab"))) == 2


class TestEndRequest:
    def test_request_ends_an_ordinary_block_at_once(self) -> None:
        ending = EndRequest()
        with pytest.raises(KeyboardInterrupt):
            ending.request()

    def test_second_request_ends_a_postponed_block(self) -> None:
        messages: list[str] = []
        ending = EndRequest(messages.append)
        with ending.postponed("ending soon"):
            ending.request()
            assert ending.is_requested
            with pytest.raises(KeyboardInterrupt):
                ending.request()
        assert messages == ["ending soon"]

    def test_waiting_in_a_postponed_block_ends_at_once(self) -> None:
        ending = EndRequest(lambda sentence: None)
        with ending.postponed("ending soon"):
            with pytest.raises(KeyboardInterrupt), ending.at_once():
                ending.request()
            with pytest.raises(KeyboardInterrupt), ending.at_once():
                raise AssertionError("begun")

    def test_ctrl_c_waits_for_a_postponed_block(self, capfd: pytest.CaptureFixture[str]) -> None:
        # A shell that is not interactive starts what it puts in the background with SIGINT ignored.
        inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
        previous = signal.getsignal(signal.SIGINT)
        with orderly_end() as ending, ending.postponed("ending soon"):
            signal.raise_signal(signal.SIGINT)
            assert ending.is_requested
        assert "ending soon" in capfd.readouterr().err
        assert signal.getsignal(signal.SIGINT) == previous
        signal.signal(signal.SIGINT, inherited)


def test_reports_a_missing_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    message = "the current folder does not exist any more; change to an existing one"
    assert run(lambda: Path("x").resolve()) == 2
    assert message in capsys.readouterr().err

    missing = FormatError("x is no session: it holds no journal.sqlite; name a folder made by acquire run or import")
    assert run(failing(missing)) == 2
    assert message in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)


def test_quiet_shows_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    from foundation import console as command_line

    visibility: list[bool] = []

    def quiet() -> None:
        command_line._log_errors_only(True)
        visibility.append(shows_progress())
        with progress("frames") as tell:
            tell(1, 2)
        logging.getLogger("drivers").warning("not heard")
        logging.getLogger("drivers").error("heard")

    assert run(quiet) == 0
    assert visibility == [False]
    assert shows_progress()
    printed = capsys.readouterr().err
    assert printed.endswith("ERROR drivers: heard\n")
    assert printed.count("\n") == 1


@pytest.mark.slow
def test_accepts_flags_after_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from acquisition.cli import main

    out = tmp_path / "lights.csv"
    assert main(["illuminations", str(out), "--grid", "2", "-q"]) == 0
    assert out.is_file()
    assert "no such option" not in capsys.readouterr().err.lower()


def test_repeated_flag_prints_each_record_once(capsys: pytest.CaptureFixture[str]) -> None:
    app = new_app("A group.")

    @app.command()
    def work() -> None:
        logging.getLogger("drivers").info("heard")

    @app.command()
    def rest() -> None:
        pass

    assert run(lambda: app(["-v", "work", "-v"], prog_name="it")) == 0
    assert capsys.readouterr().err.count("heard") == 1
    assert run(lambda: app(["work", "-q"], prog_name="it")) == 0
    assert run(lambda: app(["rest", "--version"], prog_name="it")) == 0
    assert capsys.readouterr().out.startswith("croplab ")


PRINTING = "from foundation.console import run; import sys; sys.exit(run(lambda: print('30 \u00b0 \u2026')))"


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_replaces_characters_that_a_terminal_lacks(encoding: str) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    result = subprocess.run([sys.executable, "-c", PRINTING], capture_output=True, check=False, env=environment)
    assert (result.returncode, result.stderr) == (0, b"")
    assert result.stdout.startswith(b"30 ")


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["1", "2"])
def test_closed_streams_are_no_error(closed: str) -> None:
    words = ["sh", "-c", f'exec "$0" -c "$1" {closed}>&-', sys.executable, PRINTING]
    result = subprocess.run(words, capture_output=True, check=False)
    assert result.returncode == 0
    assert b"Traceback" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_completes_the_job_after_the_reader_ended(tmp_path: Path, unbuffered: str) -> None:
    job = "import pathlib; [print('x' * 9999, flush=True) for _ in range(9)]; pathlib.Path('done').touch()"
    program = f"import sys; from foundation.console import run; sys.exit(run(lambda: exec({job!r})))"
    reader, writer = os.pipe()
    os.close(reader)
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered, "PYTHONPATH": str(Path(__file__).parents[2])}
    words = [sys.executable, "-c", program]
    ended = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, cwd=tmp_path, env=environment, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert (tmp_path / "done").exists()
