"""What a page is told of a session, as JSON: times in milliseconds since 1970 UTC, numbers to six digits.

The page's script (`web/page.js`) reads exactly this. All of it is data; the page makes elements of it, never markup.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any

import numpy as np

from acquisition.monitor.head import Head
from acquisition.monitor.rows import AttemptView, EventView
from experiment.lights.illuminations import Illumination
from experiment.session.judgement import Check
from experiment.session.plan import SessionStep
from foundation.colorimetry import decode_srgb

Json = dict[str, Any]
"""A JSON object."""


def session_json(
    name: str, steps: tuple[SessionStep, ...], lights: tuple[Illumination, ...], records: Mapping[str, str]
) -> Json:
    """Return what does not change while a session is taken: its name, plan, lights and devices.

    A step is [number, kind, light, red, green, blue], a light [index, kind, K, [r, b], red, green, blue]; its
    chromaticity is that of `experiment.lights.plots`, None for one without any light.
    """
    kinds = {light.index: (light.kind, light.cct_k) for light in lights}
    shown = {step.illumination: step.colour for step in steps if step.illumination is not None}
    codes = {index: colour.codes for index, colour in sorted(shown.items())}
    places = planned_places(list(codes.values()))
    return {
        "name": name,
        "steps": [[step.number, step.kind, step.illumination, *step.colour.codes] for step in steps],
        "lights": [
            [index, *kinds.get(index, ("", None)), place, *codes[index]]
            for index, place in zip(codes, places, strict=True)
        ],
        "records": [[key, text] for key, text in records.items()],
    }


def planned_places(codes: Sequence[tuple[int, int, int]]) -> list[list[float] | None]:
    """Return the chromaticities [r, b] of the linear light that codes stand for, 0 … 1; None for no light."""
    linear = decode_srgb(np.array(codes, dtype=np.float64).reshape(-1, 3) / 255)
    return [place_of(red, green, blue) for red, green, blue in linear.tolist()]


def place_of(red: float, green: float, blue: float) -> list[float] | None:
    """Return the chromaticity [r, b] of linear values; None unless they are a light's."""
    total = red + green + blue
    if not math.isfinite(total) or total <= 0:
        return None
    return [float(f"{red / total:.6g}"), float(f"{blue / total:.6g}")]


def attempt_json(view: AttemptView, white: tuple[float, float, float] | None, preview: int | None) -> Json:
    """Return an attempt.

    `white`: what was seen of the white frame that it is held against; None if there is none. `preview`: what names the
    version of its picture; None if there is none.
    """
    seen = view.seen
    place = place_of(*(one / of for one, of in zip(seen, white, strict=True))) if seen and white else None
    told: Json = {
        "id": view.id,
        "step": view.step,
        "at": _milliseconds(view.started_at),
        "taken": _milliseconds(view.taken_at),
        "verdict": view.verdict,
        "reason": view.reason,
        "seen": [_rounded(value) for value in seen] if seen else None,
        "seen_at": place,
        "checks": [_check(check) for check in view.checks],
        "timings": {name: _rounded(seconds) for name, seconds in view.timings.items()},
        "seconds": None if view.seconds is None else _rounded(view.seconds),
        "preview": preview if view.has_frame else None,
    }
    return {key: value for key, value in told.items() if value not in (None, "", {}, [])}


def event_json(event: EventView) -> list[Any]:
    """Return an event: [time, what, detail]."""
    return [_milliseconds(event.at), event.what, event.detail]


def head_json(head: Head) -> Json:
    """Return how a session stands."""
    return {
        name: _milliseconds(value) if isinstance(value, datetime) else value for name, value in asdict(head).items()
    }


def to_bytes(told: Json) -> bytes:
    """Return JSON as it is sent; no character of it ends a script element, wherever it is put."""
    text = json.dumps(told, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029").encode()


def digest(told: Json) -> str:
    """Return a short text that is another for other content."""
    return hashlib.blake2b(to_bytes(told), digest_size=6).hexdigest()


def _check(check: Check) -> list[Any]:
    """Return a check: [name, unit, value, low, high], and the reason where there is one."""
    numbers = [None if number is None else _rounded(number) for number in (check.value, check.low, check.high)]
    return [check.name, check.unit, *numbers, *([check.reason] if check.reason else [])]


def _rounded(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _milliseconds(at: datetime | None) -> int | None:
    return None if at is None else round(at.timestamp() * 1000)
