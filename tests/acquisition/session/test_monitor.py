"""The web page of a session on loopback, and the state behind it."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest

from acquisition.chart.layout import design_chart
from acquisition.cli import main
from acquisition.lights.illuminations import Illumination
from acquisition.session.folder import Session
from acquisition.session.judgement import Judgement
from acquisition.session.monitor import open_monitor
from acquisition.session.plan import plan_steps
from acquisition.session.progress import duration_text
from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from foundation.errors import FormatError, InputError

LIGHTS = tuple(Illumination(number, "uniform", None, Colour(255, number, 0)) for number in range(4))
BEGUN = datetime(2026, 1, 1, 9, 0, tzinfo=UTC)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a session of eight frames: two taken in ten seconds each, one refused."""
    folder = tmp_path / "night <1>"
    with Session.create(folder, "", design_chart(bits=1), LIGHTS, plan_steps(LIGHTS, 25)) as session:
        for number, reason in ((0, None), (1, None), (2, "3 % clipped")):
            step = session.steps[number]
            begun = BEGUN + timedelta(seconds=10 * number)
            attempt = session.journal.begin(step, f"frames/{step.stem}", begun)
            received = session.receive(step.stem, lambda into: CapturedFrame("a.cr2", into.write(b"raw"), BEGUN))
            session.commit(
                attempt,
                received,
                Judgement.of_reason("exposure", reason),
                exposure_s=0.5,
                ended_at=begun + timedelta(seconds=10),
            )
        session.journal.note(BEGUN, "start", "8 <frames>")
    return folder


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    with open_monitor(folder, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        return answer.read().decode()


def test_the_state_is_told_as_json(address: str) -> None:
    state = json.loads(get(f"{address}/status.json"))
    assert state["total"] == 8
    assert state["done"] == 2
    assert state["lights_total"] == 4
    assert state["lights_done"] == 0
    assert state["refused"] == 1
    assert state["seconds_per_frame"] == 10
    assert state["remaining_s"] == 60


def test_the_page_tells_the_same_and_escapes_what_it_quotes(address: str) -> None:
    text = get(f"{address}/")
    assert "2 of 8" in text
    assert "1 min 00 s" in text
    assert "3 % clipped" in text
    assert "8 &lt;frames&gt;" in text
    assert "night &lt;1&gt;" in text
    assert "<frames>" not in text


def test_other_addresses_do_not_exist(address: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as caught:
        get(f"{address}/../etc/passwd")
    assert caught.value.code == 404
    caught.value.close()


def test_a_taken_port_is_said(folder: Path, address: str) -> None:
    port = int(address.rsplit(":", 1)[1])
    with pytest.raises(InputError, match=f"port {port}"):
        open_monitor(folder, port)


def test_ctrl_c_is_its_proper_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(server: ThreadingHTTPServer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", interrupted)
    assert main(["monitor", str(folder), "--port", "0"]) == 0
    printed = capsys.readouterr()
    assert "Ctrl-C ends it" in printed.out
    assert printed.err == ""


def test_no_session_no_page(tmp_path: Path) -> None:
    with pytest.raises(FormatError):
        open_monitor(tmp_path, 0)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "unknown"), (0, "0 s"), (59.6, "1 min 00 s"), (200, "3 min 20 s"), (7500, "2 h 05 min")],
)
def test_durations_read_well(seconds: float | None, text: str) -> None:
    assert duration_text(seconds) == text
