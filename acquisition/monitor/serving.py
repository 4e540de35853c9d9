"""Web server of the live page of a session (`foundation.local_server`). It reads the journal and writes nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path

from acquisition.monitor.view import SessionWatch, live_page, read_session, to_bytes
from experiment.session.journal import JOURNAL_FILE, ledger_path
from foundation.errors import FormatError
from foundation.local_server import LocalServer, Refusal, Request, Response

_FRAME = re.compile(r"frame/([1-9][0-9]{0,8})\.jpg")


def open_monitor(folder: Path, port: int, host: str = "127.0.0.1") -> MonitorServer:
    """Check the folder of a session, and return a server for it that is not started yet."""
    if (folder / JOURNAL_FILE).exists() or ledger_path(folder).exists():
        read_session(folder)
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FormatError(
            f"{folder} is not a session, because {JOURNAL_FILE} is missing; give a folder made by acquire run or "
            "import, or a folder that does not exist yet"
        )
    return MonitorServer(SessionWatch(folder), host, port)


class MonitorServer(LocalServer):
    """Server of one session."""

    command = "acquire monitor"

    def __init__(self, watch: SessionWatch, host: str, port: int) -> None:
        self.watch = watch
        self.page = live_page(watch.folder.resolve().name)
        super().__init__(host, port)

    @property
    def has_session(self) -> bool:
        """Whether there is a session to show."""
        return self.watch.head().state != "absent"

    def answer(self, request: Request) -> Response | Refusal:
        """Return the page, the changes since its last update, the summary, or the preview of an attempt."""
        match request.path:
            case "":
                text, policy = self.page
                return Response("text/html; charset=utf-8", text.encode(), {"Content-Security-Policy": policy})
            case "state.json":
                state = self.watch.state(request.query.get("since", ""))
                return Response("", b"") if state is None else Response("application/json", to_bytes(state))
            case "status.json":
                return Response("application/json", json.dumps(self.watch.head().to_plain()).encode())
            case path if match := _FRAME.fullmatch(path):
                data = self.watch.picture(int(match[1]))
                # Browsers may cache previews, because the page adds a version to their addresses.
                headers = {"Cache-Control": "private, max-age=86400"}
                return Response("image/jpeg", data, headers) if data else Refusal(404, "this frame has no preview")
            case _:
                return Refusal(404, "unknown path, expected /, /state.json, /status.json or /frame/ATTEMPT.jpg")
