"""The server of the page of a table: what it answers, what it takes, and from whom."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import AbstractContextManager
from http.server import ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from generator.cli import main
from generator.explore.explorer import Explorer, ExploreServer
from generator.pictures.random_scenes import RandomScene
from tests.generator.conftest import MakeLut
from tests.serving import serving

PNG = cv2.imencode(".png", RandomScene(0, 40, 30).read().picture)[1].tobytes()


def served(explorer: Explorer, host: str = "127.0.0.1") -> AbstractContextManager[ExploreServer]:
    return serving(ExploreServer(explorer, host, 0))


@pytest.fixture
def server(make_lut: MakeLut) -> Iterator[ExploreServer]:
    with served(Explorer("lut", make_lut(), ())) as opened:
        yield opened


def ask(
    server: ExploreServer, path: str, body: bytes | None = None, method: str | None = None, **headers: str
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Return status, headers and body of the answer; what has a body is sent by PUT."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    try:
        method = method or ("GET" if body is None else "PUT")
        connection.request(method, path, body, {name.replace("_", "-"): text for name, text in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def test_a_picture_is_sent_and_shown(server: ExploreServer) -> None:
    status, _, body = ask(server, "/picture?name=a.png", PNG)
    assert (status, json.loads(body)) == (200, {"picture": 0})
    status, headers, body = ask(server, "/counts?picture=0&light=1&rendering=codes")
    assert (status, headers["Content-Type"]) == (200, "application/octet-stream")
    assert np.frombuffer(body[:8], "<u4").tolist() == [30, 40]
    explorer = server._explorer
    image = explorer.counts(0, "1", "codes")
    assert body[8:] == image.astype("<u2").tobytes()
    told = json.loads(ask(server, "/shown.json?picture=0&light=0:.5%2B2:.5")[2])
    assert told["light"] == "0:0.5+2:0.5"
    pixel = json.loads(ask(server, "/pixel.json?picture=0&light=1&rendering=codes&x=2&y=3")[2])
    assert pixel["draws"] == 256


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/counts?picture=-1&light=1", 422),
        ("/counts?picture=%D9%A1&light=1", 422),
        ("/counts", 422),
        ("/pixel.json?picture=0&light=1&x=40&y=0", 422),
        ("/picture", 404),
        ("/templates/explore.html", 404),
        ("/../lut/lut.json", 404),
    ],
)
def test_what_cannot_be_used_is_said_in_a_sentence(server: ExploreServer, path: str, status: int) -> None:
    ask(server, "/picture?name=a.png", PNG)
    found, headers, body = ask(server, path)
    assert (found, headers["Content-Type"]) == (status, "text/plain; charset=utf-8")
    assert b"Traceback" not in body
    assert len(body) > 10


def test_the_page_stands_alone(server: ExploreServer) -> None:
    status, headers, body = ask(server, "/")
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    for elsewhere in (b'src="http', b'href="http', b"@import", b"url("):
        assert elsewhere not in body


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "evil.example"}, 421),
        ({"Content_Length": "0"}, 413),
        ({"Content_Length": "1" * 30}, 413),
        ({"Content_Length": "-5"}, 413),
        ({"Transfer_Encoding": "chunked"}, 413),
    ],
)
def test_what_others_or_too_much_send_is_not_taken(server: ExploreServer, headers: dict[str, str], status: int) -> None:
    body = b"" if set(headers) & {"Content_Length", "Transfer_Encoding"} else PNG
    found, answered, _ = ask(server, "/picture?name=a.png", body, "PUT", **headers)
    assert (found, answered["Connection"]) == (status, "close")
    assert ask(server, "/shown.json?picture=0&light=1")[0] == 422, "nothing was kept"


def test_pictures_are_taken_at_one_address_and_by_put_alone(server: ExploreServer) -> None:
    assert ask(server, "/", PNG)[0] == 404
    for method in ("POST", "PATCH", "OPTIONS", "DELETE"):
        assert ask(server, "/picture?name=a.png", PNG, method)[0] == 405
    own = f"http://127.0.0.1:{server.port}"
    assert ask(server, "/picture?name=a.png", PNG, Origin=own)[0] == 200
    assert ask(server, "/picture?name=a.png", b"no picture")[0] == 422


def test_for_other_machines_the_address_holds_a_token(make_lut: MakeLut) -> None:
    with served(Explorer("lut", make_lut(), ()), "0.0.0.0") as server:
        for path in ("/", "/table.json", "/x/table.json"):
            assert ask(server, path)[0] == 403
        assert ask(server, "/picture?name=a.png", PNG)[0] == 403
        assert ask(server, f"/{server.path}table.json")[0] == 200
        assert ask(server, f"/{server.path}picture?name=a.png", PNG)[0] == 200


@pytest.mark.slow
@pytest.mark.usefixtures("table_and_picture")
def test_the_command_says_where_and_ends_with_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(server: ThreadingHTTPServer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", interrupt)
    assert main(["explore", "lut", "--sources", "cat.png", "--port", "0"]) == 0
    printed = capsys.readouterr()
    assert "http://127.0.0.1:" in printed.out
    assert printed.err == ""
    assert main(["-q", "explore", "lut", "--sources", "cat.png", "--port", "0"]) == 0
    assert main(["explore", "lut", "--sources", "dog.png"]) == 2
    assert "there is no dog.png" in capsys.readouterr().err
    assert main(["explore", "nothing"]) == 2
    assert main(["explore"]) == 2
