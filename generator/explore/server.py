"""The server of the page of `generate explore`; see `foundation.local_server`. It writes no file that stays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, ClassVar, Final, get_args

import numpy as np

from foundation.errors import CropError, InputError
from foundation.local_server import LocalServer, Refusal, Request, Response
from foundation.pages import render
from generator.explore.explorer import Explorer
from generator.rendering import Rendering

MOST_BYTES: Final = 64 << 20
"""Bytes of a file that a page sends: photographs of 16 bits, and not a film."""


class ExploreServer(LocalServer):
    """Serves a table and its pictures.

    - ``table.json``: the table, lights, gamut.
    - ``shown.json?picture=N&light=TEXT``: a picture under a light without its pixels, and the commands.
    - ``counts?picture=N&light=TEXT&rendering=NAME``: its image; height and width as two uint32, then the counts as
      uint16, R, G, B, row by row, all little-endian.
    - ``pixel.json?…&x=X&y=Y``: the noise of a pixel.
    - ``picture?name=NAME`` by PUT: a picture's file; answered with its number.
    """

    command = "generate explore"
    most_bytes: ClassVar[int] = MOST_BYTES

    def __init__(self, explorer: Explorer, host: str, port: int) -> None:
        self._explorer = explorer
        title = f"Explore {explorer.lut.provenance.camera}"
        scripts = ("plane.js", "picture.js", "explore.js")
        self._page = render(
            "generator.explore", "explore.html", scripts=scripts, styles=("explore.css",), connects=True, title=title
        )
        super().__init__(host, port)

    def answer(self, request: Request) -> Response | Refusal:
        """Return the answer; of what cannot be used, the sentence that a command would end with."""
        try:
            return self._answer(request)
        except CropError as error:
            return Refusal(422, str(error))

    def _answer(self, request: Request) -> Response | Refusal:
        asked, explorer = request.query, self._explorer
        if request.body is not None:
            if request.path != "picture":
                return Refusal(404, "pictures are taken at /picture")
            return _json({"picture": explorer.add(asked.get("name", "picture"), request.body)})
        match request.path:
            case "":
                policy = f"{self._page.policy}; frame-ancestors 'none'"
                return Response(
                    "text/html; charset=utf-8", self._page.text.encode(), {"Content-Security-Policy": policy}
                )
            case "table.json":
                return _json(explorer.describe())
            case "shown.json":
                return _json(explorer.show(_number(asked, "picture"), asked.get("light", "")))
            case "counts":
                image = explorer.counts(_number(asked, "picture"), asked.get("light", ""), _rendering(asked))
                size = np.array(image.shape[:2], "<u4").tobytes()
                return Response("application/octet-stream", size + image.astype("<u2", copy=False).tobytes())
            case "pixel.json":
                x, y = _number(asked, "x"), _number(asked, "y")
                return _json(explorer.pixel(_number(asked, "picture"), asked.get("light", ""), _rendering(asked), x, y))
            case _:
                return Refusal(404, "here are /, /table.json, /shown.json, /counts and /pixel.json")


def _json(value: Any) -> Response:
    return Response("application/json", json.dumps(value, allow_nan=False).encode())


def _number(asked: Mapping[str, str], name: str) -> int:
    text = asked.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise InputError(f"{name}={text[:40]!r} is no number from 0")
    return int(text)


def _rendering(asked: Mapping[str, str]) -> Rendering:
    text = asked.get("rendering", "codes")
    for known in get_args(Rendering):
        if text == known:
            return known
    raise InputError(f"{text[:40]!r} is no rendering; expected one of {', '.join(get_args(Rendering))}")
