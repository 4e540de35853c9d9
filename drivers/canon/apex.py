"""Canon's codes for shutter time, aperture and ISO speed, and the values engraved on the camera.

A code counts eighths of a stop. What the camera shows, and what people write, is a rounded nominal value: 1/60 s for
1/64 s, f/3.5 for f/3.564. Third stops and half stops share some nominal values (1/10 s is 0x53 and 0x54); a body
works in one or the other, so that its own list of available codes decides.

Rules that hold inside:

- A value is found by its nominal number within 1 %, or not at all: nothing is rounded to a neighbour. The error lists
  what is near.
- A camera's code that has no entry is no error by itself: it has a label, but no value.

Source: APEX (ISO 12232:2019 for speeds, ISO 516 and ISO 517 series for times and apertures) in eighths of a stop;
nominal values as EOS bodies show them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from foundation.errors import InputError, ProtocolError

TOLERANCE = 0.01
"""How far, of one, a wanted value may lie from a nominal one; neighbouring nominal values are 5 % apart or more."""
_HIGHEST_CODE = 0xFF
"""Codes are one byte: the law of stops has no meaning beyond."""


@dataclass(frozen=True)
class DialPosition:
    """One position of a dial: the camera's code, its label, and the nominal value (s, f-number or ISO)."""

    code: int
    label: str
    value: float


@dataclass(frozen=True)
class Scale:
    """A dial: its steps by ascending code, special codes without a value, and the law behind them."""

    name: str
    steps: tuple[DialPosition, ...]
    specials: dict[int, str]
    law: Callable[[int], float] = field(repr=False)

    def exact(self, code: int) -> float:
        """Return the value that `code` stands for in stops, unrounded: 2^(−5) s where the camera shows 1/30."""
        if code in self.specials or not 0 <= code <= _HIGHEST_CODE:
            raise ProtocolError(f"{self.name} {self.label(code)} has no value")
        return self.law(code)

    def label(self, code: int) -> str:
        """Return what the camera shows for `code`; the code itself where it is in no table."""
        if code in self.specials:
            return self.specials[code]
        step = self._step(code)
        return f"code 0x{code:02x}" if step is None else step.label

    def value(self, code: int) -> float:
        """Return the nominal value of a code that a camera reports."""
        step = self._step(code)
        if step is None:
            raise ProtocolError(
                f"the camera reports {self.name} {self.label(code)} (0x{code:02x}), which is no fixed value; "
                "turn its mode dial to M and set a value"
            )
        return step.value

    def code(self, wanted: float | str, available: Iterable[int] | None = None) -> int:
        """Return the code of a nominal value or label, one of `available` where a camera's list is given.

        `wanted`: seconds, f-number or ISO speed; or text as on the dial: ``1/60``, ``0.5``, ``30``, ``auto``, ``bulb``.
        """
        offered = None if available is None else tuple(available)
        for code, label in self.specials.items():
            if isinstance(wanted, str) and wanted.strip().lower() == label and (offered is None or code in offered):
                return code
        number = _number(wanted)
        steps = [step for step in self.steps if offered is None or step.code in offered]
        fitting = [step for step in steps if number is not None and _near(number, step.value)]
        if not fitting:
            raise self._absent(wanted, number, steps)
        # Third stops before half stops (code ≡ 4 mod 8), then the nearer nominal value, then the lower code.
        best = min(fitting, key=lambda step: (step.code % 8 == 4, abs(step.value / (number or 1) - 1), step.code))
        return best.code

    def labels(self, codes: Iterable[int]) -> str:
        """Return what the camera shows for `codes`, in their order, for a message."""
        return ", ".join(self.label(code) for code in codes) or "nothing"

    def _step(self, code: int) -> DialPosition | None:
        return next((step for step in self.steps if step.code == code), None)

    def _absent(self, wanted: float | str, number: float | None, steps: list[DialPosition]) -> InputError:
        near = steps if number is None else sorted(steps, key=lambda step: abs(math.log2(step.value / number)))[:4]
        offers = ", ".join(dict.fromkeys(step.label for step in sorted(near, key=lambda step: step.code)))
        return InputError(f"{self.name} {wanted} is not offered; near it: {offers or 'nothing, the list is empty'}")


def _number(wanted: float | str) -> float | None:
    """Return the positive number that `wanted` is or spells, or None."""
    if isinstance(wanted, str):
        over, slash, under = wanted.strip().lower().removesuffix("s").removeprefix("f/").partition("/")
        try:
            number = float(over) / float(under) if slash else float(over)
        except (ValueError, ZeroDivisionError):
            return None
    else:
        number = float(wanted)
    return number if 0 < number < math.inf else None


def _near(number: float, nominal: float) -> bool:
    return abs(number / nominal - 1) <= TOLERANCE


def _scale(name: str, table: str, specials: dict[int, str], law: Callable[[int], float]) -> Scale:
    steps: list[DialPosition] = []
    for entry in table.split():
        code, label = entry.split("=")
        value = _number(label)
        assert value is not None
        steps.append(DialPosition(int(code, 16), label, value))
    return Scale(name, tuple(sorted(steps, key=lambda step: step.code)), specials, law)


SHUTTER = _scale(
    "shutter time",
    """
    10=30 13=25 14=20 15=20 18=15 1B=13 1C=10 1D=10 20=8 23=6 24=6 25=5 28=4 2B=3.2 2C=3 2D=2.5 30=2 33=1.6 34=1.5
    35=1.3 38=1 3B=0.8 3C=0.7 3D=0.6 40=0.5 43=0.4 44=0.3 45=0.3 48=1/4 4B=1/5 4C=1/6 4D=1/6 50=1/8 53=1/10 54=1/10
    55=1/13 58=1/15 5B=1/20 5C=1/20 5D=1/25 60=1/30 63=1/40 64=1/45 65=1/50 68=1/60 6B=1/80 6C=1/90 6D=1/100
    70=1/125 73=1/160 74=1/180 75=1/200 78=1/250 7B=1/320 7C=1/350 7D=1/400 80=1/500 83=1/640 84=1/750 85=1/800
    88=1/1000 8B=1/1250 8C=1/1500 8D=1/1600 90=1/2000 93=1/2500 94=1/3000 95=1/3200 98=1/4000 9B=1/5000 9C=1/6000
    9D=1/6400 A0=1/8000 A8=1/16000
    """,
    {0x00: "auto", 0x0C: "bulb", 0x04: "bulb"},
    lambda code: 2.0 ** ((0x38 - code) / 8),
)
"""Shutter time in seconds (property 0xd102)."""

APERTURE = _scale(
    "aperture",
    """
    08=1 0B=1.1 0C=1.2 0D=1.2 10=1.4 13=1.6 14=1.8 15=1.8 18=2 1B=2.2 1C=2.5 1D=2.5 20=2.8 23=3.2 24=3.5 25=3.5
    28=4 2B=4.5 2C=4.5 2D=5 30=5.6 33=6.3 34=6.7 35=7.1 38=8 3B=9 3C=9.5 3D=10 40=11 43=13 44=13 45=14 48=16 4B=18
    4C=19 4D=20 50=22 53=25 54=27 55=29 58=32 5B=36 5C=38 5D=40 60=45
    """,
    {0x00: "auto", 0xB0: "auto", 0xFFFF: "auto"},
    lambda code: 2.0 ** ((code - 8) / 16),
)
"""Aperture as f-number (property 0xd101); 0 also where the lens has no contacts."""

ISO = _scale(
    "ISO speed",
    """
    40=50 43=64 45=80 48=100 4B=125 4D=160 50=200 53=250 55=320 58=400 5B=500 5D=640 60=800 63=1000 65=1250 68=1600
    6B=2000 6D=2500 70=3200 73=4000 75=5000 78=6400 7B=8000 7D=10000 80=12800 83=16000 85=20000 88=25600 8B=32000
    8D=40000 90=51200 93=64000 95=80000 98=102400
    A0=204800 A8=409600
    """,
    {0x00: "auto", 0x01: "auto"},
    lambda code: 100 * 2.0 ** ((code - 0x48) / 8),
)
"""ISO speed (property 0xd103)."""
