"""The monitor's page as one HTML text: style, script and, in a report, data stand in it, so that it needs nothing else.

The policy that goes with it (Content Security Policy, level 3) lets a browser run this script and no other, so that a
name or a sentence out of a session cannot become code even if it reached the page as markup.

`report.html` is what the live page shows at the end of a session, in one file that needs no server and no network.
Pictures stand in it, those of refused frames first, up to a bound; `previews/` and the raw files have the others.
"""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from pathlib import Path

from acquisition.monitor.feed import SessionWatch, head_json, read_picture, to_bytes
from acquisition.monitor.view import AttemptView, Head, SessionView, read_session
from experiment.session.heartbeat import Process
from experiment.session.records import ACCEPTED, duration_text
from foundation.errors import FormatError
from foundation.files import write_whole

REPORT_FILE = "report.html"
"""Name of a session's report in its folder."""

MOST_PICTURES_BYTES = 6 << 20
"""Bytes of all pictures in a report: with the third that base64 adds it can still be mailed (10 MB at most servers)."""

SCRIPTS = ("plots.js", "head.js", "series.js", "page.js")
"""Files that make up the page's script, in the order in which they stand in it; the last one begins."""

_PLACE = re.compile(r"\{(title|plain|policy|data|style|script)\}")


def live_page(name: str) -> tuple[str, str]:
    """Return the page that asks its server for the session's state, and the policy that the server sends along.

    `name` is shown until the server has answered.
    """
    plain = "This page shows the session by a script, which the browser does not run. See acquire status instead."
    policy = _policy("connect-src 'self'; img-src 'self' data:; frame-ancestors 'none'")
    return _filled(title=name, plain=plain, policy="", data=""), policy


def write_session_report(folder: Path, path: Path | None = None) -> Path:
    """Write the report of the session in `folder`, into it where no path is given, and return its path.

    To be called at the end of a run, also by the run itself: a run that goes on in this very process counts as ended.
    """
    path = folder / REPORT_FILE if path is None else path
    read_session(folder)
    watch = SessionWatch(folder)
    state, view = watch.state(), watch.view()
    if state is None or view is None:
        raise FormatError("has gone while its report was made", about=folder, remedy="name a session")
    now = datetime.now(UTC)
    head = _ended(view).head(now)
    state["head"] = head_json(head)
    state["pictures"] = {str(number): _data_url(data) for number, data in _pictures(folder, view.attempts)}
    text = _filled(
        title=f"{view.name}, report of {now.astimezone():%Y-%m-%d %H:%M}",
        plain=_plain(head),
        policy=f'<meta http-equiv="Content-Security-Policy" content="{_policy("img-src data:")}">',
        data=f'<script type="application/json" id="embedded">{to_bytes(state).decode()}</script>',
    )
    write_whole(path, text)
    return path


def _ended(view: SessionView) -> SessionView:
    """Return a session whose run, if this process is at it, has ended."""
    beat = view.heartbeat
    if beat is None or beat.process != Process.own() or beat.state == "ended":
        return view
    return replace(view, heartbeat=replace(beat, state="ended", sentence=""))


def _pictures(folder: Path, attempts: Sequence[AttemptView]) -> Iterator[tuple[int, bytes]]:
    """Yield attempts with their pictures, as many as fit: the refused ones, then the last, then evenly spread ones."""
    left = MOST_PICTURES_BYTES
    refused = [view for view in attempts if view.has_frame and view.verdict not in (None, ACCEPTED)]
    accepted = [view for view in attempts if view.verdict == ACCEPTED]
    for view in [*refused, *(accepted[place] for place in _spread(len(accepted)))]:
        data = read_picture(folder, view.file)
        if data and len(data) <= left:
            left -= len(data)
            yield view.id, data


def _spread(count: int) -> list[int]:
    """Return 0 … count − 1 so that any number of them from the front is spread evenly; the last and the first lead."""
    places = dict.fromkeys([count - 1, 0] if count else [])
    step = count
    while step > 1:
        step = (step + 1) // 2
        places |= dict.fromkeys(range(0, count, step))
    return list(places)


def _data_url(data: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def _plain(head: Head) -> str:
    """Return the most important of it in a few lines."""
    return "\n".join(
        (
            head.sentence,
            f"frames {head.done} of {head.total}, lights {head.lights_done} of {head.lights_total}",
            f"refused {head.refused}, failed {head.failed}, voided {head.voided}",
            f"a frame took {duration_text(head.seconds_per_frame)}",
            "Pictures and plots are shown by a script, which this viewer does not run; open the file in a browser.",
        )
    )


def _filled(*, title: str, plain: str, policy: str, data: str) -> str:
    values = {
        "title": html.escape(title),
        "plain": html.escape(plain),
        "policy": policy,
        "data": data,
        "style": _part("page.css"),
        "script": _script(),
    }
    # In one pass: what is put in is not looked through for further places.
    return _PLACE.sub(lambda found: values[found[1]], _part("page.html"))


@cache
def _part(name: str) -> str:
    return (resources.files("acquisition.monitor") / "web" / name).read_text(encoding="utf-8")


def _script() -> str:
    return "".join(map(_part, SCRIPTS))


def _policy(more: str) -> str:
    style, script = _hash(_part("page.css")), _hash(_script())
    return f"default-src 'none'; script-src {script}; style-src {style}; base-uri 'none'; form-action 'none'; {more}"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
