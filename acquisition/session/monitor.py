"""A session's state as a live web page on this machine: a page that renews itself, and the same as JSON.

Reads the session folder anew for each request and never writes to it, so it can run beside `acquire run`, and be
started and ended at any time.
"""

from __future__ import annotations

import html
import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from acquisition.session.folder import Session
from acquisition.session.progress import Progress, duration_text, session_progress
from acquisition.session.records import SessionEvent
from foundation.errors import CropError, InputError

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="refresh" content="5">
<meta name="viewport" content="width=device-width"><title>{done}/{total} {name}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 46rem; margin: 3rem auto; padding: 0 1rem; color: #222; }}
h1 {{ font-weight: 600; }} progress {{ width: 100%; height: 1.4rem; accent-color: #2a7; }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.5rem; }}
dt {{ color: #666; }} dd {{ margin: 0; }}
.refused {{ color: #b30; }} table {{ border-collapse: collapse; }} td {{ padding: .1rem 1rem .1rem 0; color: #444; }}
@media (prefers-color-scheme: dark) {{ body {{ background: #161616; color: #ddd; }} td, dt {{ color: #aaa; }} }}
</style></head><body>
<h1>{name}</h1>
<progress value="{done}" max="{total}"></progress>
<dl><dt>frames</dt><dd>{done} of {total}</dd><dt>lights</dt><dd>{lights_done} of {lights_total}</dd>
<dt>time left</dt><dd>{remaining}</dd><dt>last frame</dt><dd>{last}</dd>
<dt>refused, failed</dt><dd>{refused}, {failed}</dd></dl>
{refusals}
<h2>Events</h2><table>{events}</table>
</body></html>
"""


def read_state(folder: Path) -> tuple[Progress, list[SessionEvent]]:
    """Return a session's progress and its newest events."""
    with Session.open(folder) as session:
        return session_progress(session), session.journal.events()[-20:]


def page(folder: Path) -> str:
    """Return the page as HTML text."""
    progress, events = read_state(folder)
    refusals = "".join(f"<li>{html.escape(reason)}</li>" for reason in progress.refusals)
    rows = "".join(
        f"<tr><td>{event.at:%Y-%m-%d %H:%M:%S}</td><td>{html.escape(event.what)}</td>"
        f"<td>{html.escape(event.detail)}</td></tr>"
        for event in reversed(events)
    )
    return _PAGE.format(
        name=html.escape(folder.resolve().name),
        done=progress.done,
        total=progress.total,
        lights_done=progress.lights_done,
        lights_total=progress.lights_total,
        remaining=duration_text(progress.remaining_s),
        last=f"{progress.last_frame_at:%Y-%m-%d %H:%M:%S} UTC" if progress.last_frame_at else "none yet",
        refused=progress.refused,
        failed=progress.failed,
        refusals=f'<h2>Without an accepted frame</h2><ul class="refused">{refusals}</ul>' if refusals else "",
        events=rows,
    )


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, folder: Path, port: int) -> None:
        self.folder = folder
        super().__init__(("127.0.0.1", port), _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]  # the handler's own server, by construction

    def do_GET(self) -> None:  # the name is http.server's
        try:
            if self.path == "/":
                self._answer(200, "text/html; charset=utf-8", page(self.server.folder))
            elif self.path == "/status.json":
                progress, _ = read_state(self.server.folder)
                self._answer(200, "application/json", json.dumps(progress.as_json()))
            else:
                self._answer(404, "text/plain; charset=utf-8", "here are / and /status.json\n")
        except CropError as error:
            self._answer(503, "text/plain; charset=utf-8", f"{error}\n")

    def _answer(self, status: int, kind: str, text: str) -> None:
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the terminal is the user's."""


def open_monitor(folder: Path, port: int) -> ThreadingHTTPServer:
    """Return a server for `folder` on loopback, not yet serving; port 0 takes any free one.

    Raises
    ------
    InputError
        The port is taken.
    FormatError
        The folder is no session.
    """
    read_state(folder)
    try:
        return _Server(folder, port)
    except OSError as error:
        raise InputError(f"cannot serve on port {port}: {error.strerror}; name another with --port") from error
