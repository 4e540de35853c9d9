"""Which of a frame's faults is named as the cause, and what it means for the frames around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from acquisition.judge import limits
from acquisition.judge.known.knowledge import Knowledge, is_brightest_grey
from experiment.session.plan import SessionStep
from experiment.session.records import Check

_CAUSES = (
    "file", "camera", "settings", "data", "repeated", "clipping", "exposure", "chart", "movement", "blur", "rows",
    "uniformity", "light", "ambient", "lamp", "dark", "white drift", "additivity",
)  # fmt: skip
"""Checks in the order in which they are named as the cause: what comes first explains what comes after."""

_AT_ONCE = ("camera", "chart")
"""Causes that taking the frame again never mends."""

_HIDDEN = ("ambient", "dark")
"""Causes that a reference shows and the lights between may hide: what was taken since the last good one is in doubt."""

_BY_MODEL = ("light", "uniformity", "rows", "lamp", "white drift")
"""Causes that each light shows by itself, where frames of the primaries say what it should look like."""

_FOLLOWS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "movement": frozenset({"rows", "uniformity", "blur", "light", "lamp", "white drift"}),
        "rows": frozenset({"movement", "uniformity", "blur", "light", "lamp", "white drift", "ambient"}),
        "uniformity": frozenset({"rows", "movement", "blur", "light", "lamp", "white drift", "ambient"}),
        "blur": frozenset({"rows", "uniformity"}),
        "light": frozenset({"lamp", "ambient", "white drift"}),
        "ambient": frozenset({"light", "lamp", "uniformity"}),
    }
)
"""What a cause brings about besides itself."""

_ROWS_STAND_PX = 0.7
"""Blur, px, below which rows show what belongs into them (simulated: none deviates at 0.75 px): rows that do not are
what made edges look softer, and no blur."""


def named_once(checks: Sequence[Check]) -> tuple[Check, ...]:
    """Return the checks in the order in which causes are named, what follows from the first cause without a reason."""
    # Blur is measured on tags and on rows, a light's ambient share besides its colour: what is wrong is kept.
    one = {check.name: check for check in sorted(checks, key=lambda check: bool(check.reason))}
    order = sorted(one.values(), key=lambda check: _CAUSES.index(check.name))
    reasons = [check.name for check in order if check.reason]
    if "movement" in reasons and len(reasons) > 1:
        movement = next(check for check in order if check.name == "movement")
        # Tags that are not recognised have a cause; tags that moved are one.
        if movement.value is None:
            reasons.remove("movement")
    blur = one.get("blur")
    if "rows" in reasons and "blur" in reasons and blur is not None and abs(blur.value or np.inf) < _ROWS_STAND_PX:
        reasons.remove("blur")
        one["blur"] = replace(blur, reason="")
        order = [one[check.name] for check in order]
    cause = reasons[0] if reasons else ""
    follows = _FOLLOWS.get(cause, frozenset())
    return tuple(replace(check, reason="") if check.name in follows else check for check in order)


def voids_others(known: Knowledge, cause: str) -> bool:
    """Return whether a reference that is refused for a cause puts what was taken since the last good one in doubt."""
    return cause in _HIDDEN or cause in known.untold or (cause in _BY_MODEL and not known.modelled)


def is_lasting(known: Knowledge, step: SessionStep, cause: str) -> bool:
    """Return whether taking the frame again will not help; `known` includes it."""
    # A lamp that is another one at the beginning of a run would cost every light up to the next white frame.
    another = cause == "white drift" and is_brightest_grey(step)
    # Of a session's first frame the exposure is too long, and a second one is no shorter.
    overexposed = cause == "clipping" and known.white is None
    return another or overexposed or cause in _AT_ONCE or known.refused[1] >= limits.LASTING_FRAMES
