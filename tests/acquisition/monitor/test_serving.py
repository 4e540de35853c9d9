"""Server of the monitor: its answers, and its restrictions."""

from __future__ import annotations

import gzip
import http.client
import json
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from acquisition.cli import main
from acquisition.monitor.serving import MonitorServer, open_monitor
from foundation.errors import FormatError, InputError
from tests.acquisition.monitor.made_up import MadeUpRun, jpeg
from tests.serving import serving

SCRIPT = "<script>alert(1)</script>"


def begun(folder: Path) -> MadeUpRun:
    """Return a run of four illuminants with hostile names and reasons; white and dark are accepted."""
    made = MadeUpRun.begin(folder / "night <b>1")
    made.take(made.steps[0])
    made.take(made.steps[1])
    made.take(made.steps[2], f"{SCRIPT} in the light", value=8.0)
    return made


@pytest.fixture
def run(tmp_path: Path) -> Iterator[MadeUpRun]:
    made = begun(tmp_path)
    yield made
    made.journal.close()


def served(folder: Path, host: str = "127.0.0.1") -> AbstractContextManager[MonitorServer]:
    return serving(open_monitor(folder, 0, host))


@pytest.fixture
def opened(run: MadeUpRun) -> Iterator[MonitorServer]:
    with served(run.folder) as monitor:
        yield monitor


@pytest.fixture(scope="module")
def read_only_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MonitorServer]:
    """Serve such a run for tests that only read."""
    made = begun(tmp_path_factory.mktemp("served"))
    with served(made.folder) as monitor:
        yield monitor
    made.journal.close()


def ask(
    monitor: MonitorServer, path: str, method: str = "GET", **headers: str
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Return status, headers and body of an answer; in the names of headers _ replaces -."""
    connection = http.client.HTTPConnection("127.0.0.1", monitor.port, timeout=20)
    try:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def state_of(monitor: MonitorServer, since: str = "") -> dict[str, Any]:
    status, _, body = ask(monitor, f"/state.json?since={since}")
    assert status == 200
    return json.loads(body)


def test_serves_state_to_scripts(read_only_server: MonitorServer) -> None:
    told = json.loads(ask(read_only_server, "/status.json")[2])
    assert (told["state"], told["alive"]) == ("running", True)
    assert (told["done"], told["total"]) == (2, 8)
    assert (told["lights_done"], told["lights_total"]) == (0, 4)
    assert told["refused"] == 1
    assert told["remaining_s"] == pytest.approx(6 * 5 * 3 / 2, abs=1), "two of three attempts gave a frame"


def test_page_is_self_contained_without_session_markup(read_only_server: MonitorServer) -> None:
    status, headers, body = ask(read_only_server, "/")
    text = body.decode()
    assert status == 200
    assert "night &lt;b&gt;1" in text
    assert "night <b>" not in text
    assert SCRIPT not in text
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "'unsafe" not in headers["Content-Security-Policy"]
    for elsewhere in ('src="http', 'href="http', "@import", "url("):
        assert elsewhere not in text


def test_state_has_content_of_page(opened: MonitorServer, run: MadeUpRun) -> None:
    state = state_of(opened)
    assert len(state["session"]["lights"]) == 4
    refused = state["frames"][2]
    assert refused["verdict"] == "refused"
    assert refused["reason"] == f"{SCRIPT} in the light"
    assert ["off_codes_deg", "°", 8.0, None, 1.0, f"{SCRIPT} in the light"] in refused["checks"]
    # Because of crosstalk, the camera records the red illuminant less red than its codes.
    assert refused["seen_at"][0] < 1
    assert b"<script" not in ask(opened, "/state.json")[2]


def test_sends_only_changes(opened: MonitorServer, run: MadeUpRun) -> None:
    first = state_of(opened)
    assert ask(opened, f"/state.json?since={first['cursor']}")[0] == 204
    run.take(run.steps[2])
    second = state_of(opened, str(first["cursor"]))
    assert "session" not in second
    assert 4 in [frame["id"] for frame in second["frames"]]
    assert second["head"]["done"] == 3


def test_serves_only_jpeg_pictures(opened: MonitorServer, run: MadeUpRun, tmp_path: Path) -> None:
    status, headers, body = ask(opened, "/frame/1.jpg")
    assert (status, headers["Content-Type"]) == (200, "image/jpeg")
    assert body == jpeg((255, 255, 255), "0000_white ")
    previews = run.folder / "previews"
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(b"\xff\xd8\xffsecret")
    (previews / "0001_dark.jpg").unlink()
    assert ask(opened, "/frame/2.jpg")[0] == 404
    (previews / "0001_dark.jpg").symlink_to(secret)
    assert ask(opened, "/frame/2.jpg")[0] == 404
    (previews / "0000_white.jpg").write_bytes(b"<html>no picture")
    assert ask(opened, "/frame/1.jpg")[0] == 404


def test_serves_only_files_of_previews(opened: MonitorServer, run: MadeUpRun) -> None:
    (run.folder / "secret.jpg").write_bytes(b"\xff\xd8\xffsecret")
    attempt = run.take(run.steps[2])
    run.journal._connection.execute("UPDATE attempts SET file = 'previews/../../secret.cr2' WHERE id = ?", (attempt,))
    assert ask(opened, f"/frame/{attempt}.jpg")[0] == 404


@pytest.mark.parametrize("since", ["x", "..", "a.b.c", "%00", "0.-1.0", "'", "9" * 5000])
def test_sends_everything_for_unknown_cursor(read_only_server: MonitorServer, since: str) -> None:
    assert "session" in state_of(read_only_server, since)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_is_read_only(read_only_server: MonitorServer, method: str) -> None:
    status, headers, _ = ask(read_only_server, "/", method)
    assert (status, headers["Allow"]) == (405, "GET, HEAD")


def test_compresses_large_answers(read_only_server: MonitorServer) -> None:
    _, headers, body = ask(read_only_server, "/", Accept_Encoding="gzip")
    assert headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(body) == ask(read_only_server, "/")[2]


def test_follows_deleted_and_restored_session(opened: MonitorServer, run: MadeUpRun) -> None:
    first = state_of(opened)
    away = run.folder.with_name("away")
    run.folder.rename(away)
    gone = state_of(opened, str(first["cursor"]))
    assert gone["head"]["state"] == "gone"
    assert "frames" not in gone
    assert ask(opened, "/frame/1.jpg")[0] == 404
    shutil.copytree(away, run.folder)
    back = state_of(opened, str(gone["cursor"]))
    assert "session" in back
    assert len(back["frames"]) == 3


def test_reports_damaged_journal(opened: MonitorServer, run: MadeUpRun) -> None:
    run.journal.close()
    (run.folder / "journal.sqlite").write_bytes(b"SQLite format 3\0" + b"\xff" * 5000)
    head = state_of(opened)["head"]
    assert head["state"] == "unreadable"
    assert "restore it from a copy" in head["sentence"]


def test_waits_for_session(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    with served(folder) as monitor:
        absent = state_of(monitor)
        assert absent["head"]["state"] == "absent"
        made = MadeUpRun.begin(folder)
        assert "session" in state_of(monitor, str(absent["cursor"]))
        made.journal.close()


def test_writes_nothing(run: MadeUpRun) -> None:
    run.journal.close()
    before = {path: path.stat() for path in sorted(run.folder.rglob("*"))}
    with served(run.folder) as monitor:
        state_of(monitor)
        ask(monitor, "/frame/1.jpg")
    after = {path: path.stat() for path in sorted(run.folder.rglob("*"))}
    assert before.keys() == after.keys()
    for path, was in before.items():
        assert (was.st_mtime_ns, was.st_size, was.st_ino) == (
            after[path].st_mtime_ns,
            after[path].st_size,
            after[path].st_ino,
        )


def test_reports_used_port(run: MadeUpRun, opened: MonitorServer) -> None:
    with pytest.raises(InputError, match=f"port {opened.port}"):
        open_monitor(run.folder, opened.port)


def test_refuses_folder_without_session(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("hello")
    with pytest.raises(FormatError):
        open_monitor(tmp_path, 0)
    with pytest.raises(FormatError):
        open_monitor(tmp_path / "letter.txt", 0)


def test_ends_by_ctrl_c(run: MadeUpRun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", Mock(side_effect=KeyboardInterrupt))
    assert main(["monitor", str(run.folder), "--port", "0"]) == 0
    printed = capsys.readouterr()
    assert "http://127.0.0.1:" in printed.out
    assert "Ctrl-C ends it" in printed.out
    assert printed.err == ""
