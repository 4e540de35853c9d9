"""The monitor's server: what it answers, to whom, and what it never does.

Who may look, and at what.

The QR code in the terminal is read by a reader of such codes.
"""

from __future__ import annotations

import gzip
import http.client
import ipaddress
import json
import re
import shutil
import socket
import sys
import threading
import tomllib
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.cli import main
from acquisition.monitor.serving import MonitorServer, open_monitor
from foundation import local_server as server
from foundation.errors import FormatError, InputError
from foundation.local_server import Access, Refusal, Request, is_loopback, qr_text, reachable_addresses
from tests.acquisition.monitor.made_up import MadeUpRun, jpeg

OPEN = Access("", frozenset({"localhost"}), "acquire monitor")
CLOSED = Access("secret", frozenset({"localhost"}), "acquire monitor")


@pytest.mark.parametrize(
    ("target", "request_"),
    [
        ("/", Request("")),
        ("/?", Request("")),
        ("/state.json", Request("state.json")),
        ("/state.json?since=a.1.b&since=c", Request("state.json", {"since": "a.1.b"})),
        ("/frame/12.jpg?1", Request("frame/12.jpg")),
    ],
)
def test_an_address_is_a_path_and_a_query(target: str, request_: Request) -> None:
    assert OPEN.judge(target, "localhost") == request_
    assert CLOSED.judge(f"/secret{target}", "localhost") == request_


@pytest.mark.parametrize("target", ["/frame/١.jpg", "/frame/1.jpg\n", "//[", "/%", "", "http://localhost/", "*"])
def test_what_is_no_address_is_refused(opened: MonitorServer, target: str) -> None:
    asked = OPEN.judge(target, "localhost")
    assert isinstance(asked, Request)
    assert isinstance(opened.answer(asked), Refusal) == (target != "")


@pytest.mark.parametrize(
    ("origin", "is_taken"),
    [
        (None, True),
        ("http://localhost:8707", True),
        ("HTTP://LOCALHOST:8707", True),
        ("http://localhost:80", False),
        ("https://localhost:8707", False),
        ("http://evil.example", False),
        ("null", False),
    ],
)
def test_what_another_sites_page_sends_is_refused(origin: str | None, is_taken: bool) -> None:
    assert isinstance(OPEN.judge("/", "localhost:8707", origin), Request) == is_taken


@given(st.text(max_size=40), st.text(max_size=20))
def test_without_the_token_nothing_is_shown(target: str, host: str) -> None:
    for asked in (target, f"/{target}", "/" + target.replace("secret", "")):
        assert isinstance(CLOSED.judge(asked, host), Refusal) or asked.startswith("/secret/")


@given(st.text(max_size=60))
def test_only_numbers_and_own_names_are_known(host: str) -> None:
    answer = OPEN.judge("/", host)
    if answer == Request(""):
        name = host.lower().partition(":")[0] if not host.startswith("[") else host[1:].partition("]")[0]
        assert name == "localhost" or ipaddress.ip_address(name)


def test_a_token_is_asked_for_wherever_others_reach_it() -> None:
    assert Access.to("127.0.0.1", "x").token == ""
    assert Access.to("localhost", "x").token == ""
    assert Access.to("::1", "x").token == ""
    for host in ("0.0.0.0", "::", "192.168.1.7", socket.gethostname() + ".example"):
        assert len(Access.to(host, "x").token) >= 22
    assert not is_loopback("127.0.0.1.example")


def test_where_others_reach_it() -> None:
    assert reachable_addresses("192.168.1.7") == ("192.168.1.7",)
    assert reachable_addresses("fd00::7") == ("[fd00::7]",)
    assert reachable_addresses("lab.local") == ("lab.local",)
    assert all(name and "0.0.0.0" not in name for name in reachable_addresses("0.0.0.0"))


def test_without_a_network_it_goes_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(self: socket.socket, address: object) -> None:
        raise OSError("Network is unreachable")

    monkeypatch.setattr(socket.socket, "connect", unreachable)
    assert reachable_addresses("0.0.0.0") == (socket.gethostname(),)


ADDRESS = "http://192.168.178.123:8707/abcdefghijklmnopqrstuv/"


def test_a_reader_finds_the_address_in_what_is_printed() -> None:
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in qr_text(ADDRESS).splitlines()]
    assert len({len(line) for line in lines}) == 1
    light = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}
    rows = [[light[character][half] for character in line] for line in lines for half in (0, 1)]
    picture = np.kron(np.array(rows, np.uint8) * 255, np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == ADDRESS
    # ISO/IEC 18004, 6.3.8: four light modules on each side.
    assert all(all(row[:4]) and all(row[-4:]) for row in rows)
    assert all(all(row) for row in rows[:4] + rows[-4:])


def test_it_fits_a_terminal_of_80_columns() -> None:
    assert max(len(re.sub(r"\x1b\[[0-9;]*m", "", line)) for line in qr_text(ADDRESS).splitlines()) <= 80


SCRIPT = "<script>alert(1)</script>"


@pytest.fixture
def run(tmp_path: Path) -> Iterator[MadeUpRun]:
    """Return a run of four lights with hostile names and reasons: white and dark taken, the first light refused."""
    made = MadeUpRun.begin(tmp_path / "night <b>1")
    made.take(made.steps[0])
    made.take(made.steps[1])
    made.take(made.steps[2], f"{SCRIPT} in the light", value=8.0)
    yield made
    made.journal.close()


@contextmanager
def served(folder: Path, host: str = "127.0.0.1") -> Generator[MonitorServer]:
    with open_monitor(folder, 0, host) as opened:
        thread = threading.Thread(target=lambda: opened.serve_forever(0.01))
        thread.start()
        yield opened
        opened.shutdown()
        thread.join()


@pytest.fixture
def opened(run: MadeUpRun) -> Iterator[MonitorServer]:
    with served(run.folder) as monitor:
        yield monitor


def ask(
    monitor: MonitorServer, path: str, method: str = "GET", **headers: str
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Return status, headers and body of the answer; names of headers with _ for -."""
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


def test_how_the_session_stands_is_told_to_scripts(opened: MonitorServer) -> None:
    told = json.loads(ask(opened, "/status.json")[2])
    assert (told["state"], told["alive"]) == ("running", True)
    assert (told["done"], told["total"]) == (2, 8)
    assert (told["lights_done"], told["lights_total"]) == (0, 4)
    assert told["refused"] == 1
    assert told["remaining_s"] == pytest.approx(6 * 5 * 3 / 2, abs=1), "two of three attempts gave a frame"


def test_the_page_stands_alone_and_holds_no_markup_of_the_session(opened: MonitorServer) -> None:
    status, headers, body = ask(opened, "/")
    text = body.decode()
    assert status == 200
    assert "night &lt;b&gt;1" in text
    assert "night <b>" not in text
    assert SCRIPT not in text
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "'unsafe" not in headers["Content-Security-Policy"]
    for elsewhere in ('src="http', 'href="http', "@import", "url("):
        assert elsewhere not in text


def test_the_state_has_what_the_page_draws(opened: MonitorServer, run: MadeUpRun) -> None:
    state = state_of(opened)
    assert len(state["session"]["lights"]) == 4
    refused = state["frames"][2]
    assert refused["verdict"] == "refused"
    assert refused["reason"] == f"{SCRIPT} in the light"
    assert ["light", "°", 8.0, None, 1.0, f"{SCRIPT} in the light"] in refused["checks"]
    # Red at full, green by its crosstalk: the camera sees the red light less red than its codes.
    assert refused["seen_at"][0] < 1
    assert b"<script" not in ask(opened, "/state.json")[2]


def test_nothing_new_is_no_content_and_what_is_new_comes_alone(opened: MonitorServer, run: MadeUpRun) -> None:
    first = state_of(opened)
    assert ask(opened, f"/state.json?since={first['cursor']}")[0] == 204
    run.take(run.steps[2])
    second = state_of(opened, str(first["cursor"]))
    assert "session" not in second
    assert 4 in [frame["id"] for frame in second["frames"]]
    assert second["head"]["done"] == 3


def test_a_picture_is_shown_only_as_such(opened: MonitorServer, run: MadeUpRun, tmp_path: Path) -> None:
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


def test_no_row_of_a_journal_leads_out_of_the_previews(opened: MonitorServer, run: MadeUpRun) -> None:
    (run.folder / "secret.jpg").write_bytes(b"\xff\xd8\xffsecret")
    attempt = run.take(run.steps[2])
    run.journal._connection.execute(  # pyright: ignore[reportPrivateUsage]
        "UPDATE attempts SET file = 'previews/../../secret.cr2' WHERE id = ?", (attempt,)
    )
    assert ask(opened, f"/frame/{attempt}.jpg")[0] == 404


@pytest.mark.parametrize(
    "path",
    [
        "/../etc/passwd",
        "/frame/%2e%2e/1.jpg",
        "/frame/0.jpg",
        "/frame/-1.jpg",
        "/frame/99999999999999999999.jpg",
        "/frame/7.jpg",
        "/journal.sqlite",
    ],
)
def test_other_addresses_do_not_exist(opened: MonitorServer, path: str) -> None:
    assert ask(opened, path)[0] == 404


@pytest.mark.parametrize("since", ["x", "..", "a.b.c", "%00", "0.-1.0", "'", "9" * 5000])
def test_a_strange_cursor_gives_everything(opened: MonitorServer, since: str) -> None:
    assert "session" in state_of(opened, since)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_nothing_can_be_changed(opened: MonitorServer, method: str) -> None:
    status, headers, _ = ask(opened, "/", method)
    assert (status, headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize("path", ["/", "/state.json", "/status.json", "/frame/1.jpg", "/nothing"])
def test_head_is_answered_without_a_body(opened: MonitorServer, path: str) -> None:
    status, headers, body = ask(opened, path, "HEAD")
    assert status == ask(opened, path)[0]
    assert int(headers["Content-Length"]) > 0
    assert body == b""


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8707", "127.0.0.1.evil.example", "", "[::1", "localhost.evil"]
)
def test_a_name_that_another_site_points_here_is_refused(opened: MonitorServer, host: str) -> None:
    assert ask(opened, "/state.json", Host=host)[0] == 421


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:9000", "127.0.0.1:1", "[::1]:8707", "192.168.1.7"])
def test_its_own_names_and_numbers_are_known(opened: MonitorServer, host: str) -> None:
    assert ask(opened, "/state.json", Host=host)[0] == 200


def test_for_other_machines_the_address_holds_a_token(run: MadeUpRun) -> None:
    with served(run.folder, "0.0.0.0") as monitor:
        assert len(monitor.path) > 20
        for wrong in ("", "x/", monitor.path[:-2] + "/", monitor.path.lower().swapcase()):
            for path in (f"/{wrong}", f"/{wrong}state.json", f"/{wrong}frame/1.jpg"):
                assert ask(monitor, path)[0] == 403
        assert ask(monitor, f"/{monitor.path}")[0] == 200
        assert ask(monitor, f"/{monitor.path}state.json")[0] == 200
        assert ask(monitor, f"/{monitor.path}frame/1.jpg")[0] == 200
        with served(run.folder, "0.0.0.0") as another:
            assert another.path != monitor.path


def test_the_page_goes_where_the_package_goes() -> None:
    root = Path(__file__).parents[3]
    named = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    package = root / "acquisition" / "monitor"
    parts = [path.relative_to(package) for path in package.rglob("*") if path.suffix in (".html", ".css", ".js")]
    assert len(parts) == 6
    assert all(any(part.match(pattern) for pattern in named["acquisition.monitor"]) for part in parts)


def test_a_large_answer_is_compressed_for_who_can_read_it(opened: MonitorServer) -> None:
    _, headers, body = ask(opened, "/", Accept_Encoding="gzip")
    assert headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(body) == ask(opened, "/")[2]


def test_connections_without_number_are_turned_away(run: MadeUpRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 3)
    with served(run.folder) as monitor:
        held = [socket.create_connection(("127.0.0.1", monitor.port)) for _ in range(3)]
        try:
            # Connections are accepted in their order: the first three wait for a request, the fourth finds no room.
            with socket.create_connection(("127.0.0.1", monitor.port), timeout=20) as one_more:
                assert one_more.recv(1) == b""
        finally:
            for connection in held:
                connection.close()
        assert answered_in_the_end(monitor)


def answered_in_the_end(monitor: MonitorServer) -> bool:
    """Return whether there is room again, once the threads of closed connections have ended."""
    for _ in range(1000):
        try:
            return ask(monitor, "/status.json")[0] == 200
        except (http.client.HTTPException, OSError):
            continue
    return False


def test_a_session_may_be_deleted_and_come_back_under_the_open_page(opened: MonitorServer, run: MadeUpRun) -> None:
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


def test_a_damaged_journal_is_said_on_the_page(opened: MonitorServer, run: MadeUpRun) -> None:
    run.journal.close()
    (run.folder / "journal.sqlite").write_bytes(b"SQLite format 3\0" + b"\xff" * 5000)
    head = state_of(opened)["head"]
    assert head["state"] == "unreadable"
    assert "restore it from a copy" in head["sentence"]


def test_a_session_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    with served(folder) as monitor:
        absent = state_of(monitor)
        assert absent["head"]["state"] == "absent"
        made = MadeUpRun.begin(folder)
        assert "session" in state_of(monitor, str(absent["cursor"]))
        made.journal.close()


def test_nothing_in_the_session_is_written_by_looking(run: MadeUpRun) -> None:
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


def test_a_taken_port_is_said(run: MadeUpRun, opened: MonitorServer) -> None:
    with pytest.raises(InputError, match=f"port {opened.port}"):
        open_monitor(run.folder, opened.port)


def test_a_host_that_is_none_of_ours_is_said(run: MadeUpRun) -> None:
    with pytest.raises(InputError, match=r"192\.0\.2\.1.*--host"):
        open_monitor(run.folder, 0, "192.0.2.1")


def test_a_folder_of_something_else_is_no_session(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("hello")
    with pytest.raises(FormatError, match="no session"):
        open_monitor(tmp_path, 0)
    with pytest.raises(FormatError, match="no session"):
        open_monitor(tmp_path / "letter.txt", 0)


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(server: ThreadingHTTPServer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", interrupt)


@pytest.mark.usefixtures("interrupted")
def test_ctrl_c_is_its_proper_end(run: MadeUpRun, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", str(run.folder), "--port", "0"]) == 0
    printed = capsys.readouterr()
    assert "http://127.0.0.1:" in printed.out
    assert "Ctrl-C ends it" in printed.out
    assert printed.err == ""


@pytest.mark.usefixtures("interrupted")
def test_the_address_for_a_phone_is_printed_with_a_warning_and_as_a_code(
    run: MadeUpRun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def addresses(host: str) -> tuple[str, ...]:
        return ("192.168.1.7",)

    monkeypatch.setattr(server, "reachable_addresses", addresses)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert main(["monitor", str(run.folder), "--port", "0", "--host", "0.0.0.0"]) == 0
    printed = capsys.readouterr()
    assert "http://192.168.1.7:" in printed.out
    assert "▀" in printed.out
    assert "not encrypted" in printed.err
