"""What the judge knows of a session so far, as one frozen value, and what a frame adds to it.

Rules that hold inside:

- `after` is the only way on, for a frame just judged and for one of an earlier run, so that a run that is taken up
  again knows what an uninterrupted one would.
- Only accepted frames teach. A refused one is kept as the frame before, and as what may be lasting.
- Until a light is accepted, everything that is known rests on the first frames of the session or of the run, and one of
  them may be the odd one: nothing but those that follow says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from acquisition.judge import limits
from acquisition.judge.light import Basis, Codes, FrameLight, ProjectorModel
from acquisition.judge.measure import Anchor, Frame, Measured
from experiment.session.records import PRIMARIES, REFERENCES, TOP, SessionStep

RECENT = 6
"""Frames whose noise is compared with the next one's: a camera's memory card hands out none older."""

LEANING = 3
"""Frames whose small deviations are taken together; more would take a drift that is followed for a step."""

_GREYS = 4
"""Frames of mixed light from which on white is predicted without its own: the tone curve's value, slope and bend, and
one that tells whether they agree."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame that was taken: its codes, what was measured, the amounts of light if they are known."""

    codes: Codes
    measured: Measured
    amounts: _Array | None


@dataclass(frozen=True)
class Leaning:
    """By how much lights were off that were accepted: deviations too small for one frame show in two or three.

    `lamp`, `added`: level of the lamp over the one expected (logarithm), and neutral light added (of white), of the
    newest frame first, each with its standard deviation; at most `LEANING` frames.
    """

    lamp: tuple[tuple[float, float], ...] = ()
    added: tuple[tuple[float, float], ...] = ()

    def then(self, newer: Leaning) -> Leaning:
        """Return both, the newer first."""
        return Leaning((*newer.lamp, *self.lamp)[:LEANING], (*newer.added, *self.added)[:LEANING])


@dataclass(frozen=True)
class LampSeen:
    """What a frame shows of the lamp.

    - `brightness`: its level over the one expected (logarithm); NaN where that is not known.
    - `stepped`: whether the frame is accepted at another level than expected.
    - `leaning`: how its light was off, however little.
    """

    brightness: float = float("nan")
    stepped: bool = False
    leaning: Leaning = field(default_factory=Leaning)


def combined(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the weighted mean of values with standard deviations, and its own; (0, inf) of none."""
    weights = [sd**-2 for _, sd in values]
    total = sum(weights)
    if not total:
        return 0.0, float("inf")
    return sum(value * weight for (value, _), weight in zip(values, weights, strict=True)) / total, total**-0.5


@dataclass(frozen=True, eq=False)
class Examined:
    """What was found of a frame, and said of it.

    - `frame`: what was measured.
    - `light`: its light, where a basis is known.
    - `accepted`: whether it may be used.
    - `cause`: name of the check that refused it; empty if none did.
    - `lamp`: what it showed of the lamp.
    """

    frame: Frame
    light: FrameLight | None
    accepted: bool
    cause: str = ""
    lamp: LampSeen = field(default_factory=LampSeen)


@dataclass(frozen=True, eq=False)
class JudgeState:
    """All that is known.

    - `anchor`: the chart's place.
    - `first`: the session's first accepted frame: camera, size, serial number.
    - `first_white`, `white`, `first_dark`, `dark`: accepted references.
    - `first_grey`: the first frame of the brightest grey, whose paper that of a run taken up again is held against.
    - `primaries`: frames of the three primaries at `experiment.session.records.TOP`.
    - `basis`, `model`: how a frame is a sum of primaries, and which amounts codes give.
    - `moved_px`: (2,) where the chart lies at rest, from its place in the anchor: (0, 0), or where a bump has left it.
    - `recent`: the last frames, the newest last.
    - `digests`: of all frames.
    - `untold`: names of checks that some accepted frame since the last good reference was too dark for.
    - `refused`: cause, and number, of the refusals in a row.
    - `leaning`: by how much the last lights were off.
    - `candidate`: level of the lamp (logarithm) and place of the chart (px) of the frame refused last; NaN where it was
      not that.
    - `rested`: whether the run was taken up again and no lit frame has been accepted since.
    - `moved_on`: whether the chart lies elsewhere than in the white frame that is known.
    - `asked`: whether this run has shown a primary alone, whatever the frame was like.
    - `witness`: the newest white or grey frame from before the primaries were known, by which they are held against it.
    - `lost`: whether a reference of an earlier run is accepted and its measurement cannot be read.
    - `founding`: whether no light was accepted yet in this session, or since the run was taken up again or paused.
    - `first_frames`: frames that were accepted meanwhile.
    - `doubted`: numbers of the steps whose frames these contradicted once.
    - `restarts`: how often these were taken again for that.
    - `begun_with`: number of the step of the first of them; None before it.
    - `expected`: the step that comes next unless a frame was under way when that was found; None once it is there.
    """

    anchor: Anchor | None = None
    first: Measured | None = None
    first_white: Frame | None = None
    first_grey: Frame | None = None
    white: Measured | None = None
    first_dark: Measured | None = None
    dark: Measured | None = None
    primaries: tuple[Measured | None, Measured | None, Measured | None] = (None, None, None)
    basis: Basis | None = None
    model: ProjectorModel = field(default_factory=ProjectorModel.unknown)
    moved_px: _Array | None = None
    recent: tuple[Seen, ...] = ()
    digests: frozenset[bytes] = frozenset()
    untold: frozenset[str] = frozenset()
    refused: tuple[str, int] = ("", 0)
    leaning: Leaning = field(default_factory=Leaning)
    candidate: tuple[float, float, float] = (float("nan"), float("nan"), float("nan"))
    rested: bool = False
    moved_on: bool = False
    asked: bool = False
    witness: Measured | None = None
    lost: bool = False
    founding: bool = True
    first_frames: tuple[Seen, ...] = ()
    doubted: frozenset[int] = frozenset()
    restarts: int = 0
    begun_with: int | None = None
    expected: int | None = None

    @property
    def modelled(self) -> bool:
        """Whether amounts are those of the projector's primaries, so that codes predict them."""
        return self.basis is not None and self.basis.of_primaries

    @property
    def awaits_primaries(self) -> bool:
        """Whether lights cannot be predicted only because frames that this run asked for were refused."""
        return self.asked and not self.modelled and not self.lost

    def paused(self) -> JudgeState:
        """Return what is known after a pause of the run: the lamp may be at another level, the chart elsewhere."""
        if self.rested or not self.digests:
            return self
        return replace(
            self,
            model=self.model.rested(),
            rested=True,
            recent=(),
            refused=("", 0),
            asked=False,
            founding=True,
            first_frames=(),
            doubted=frozenset(),
            begun_with=None,
        )

    def begun_anew(self, base: JudgeState) -> JudgeState:
        """Return what is known where the first frames cannot be trusted: no more than `base`, before them."""
        return replace(
            base,
            first=base.first or self.first,
            recent=self.recent,
            digests=self.digests,
            refused=self.refused,
            restarts=self.restarts + 1,
            expected=self.begun_with,
        )

    def after(self, step: SessionStep, found: Examined) -> JudgeState:
        """Return what is known after a frame of a step."""
        frame, codes = found.frame, step.colour.codes
        seen = Seen(codes, frame.measured, None if found.light is None else found.light.amounts)
        state = replace(
            self,
            recent=(*self.recent, seen)[-RECENT:],
            digests=self.digests | {frame.measured.digest},
            asked=self.asked or (step.kind == "response" and primary_of(codes) is not None),
        )
        if not found.accepted:
            count = self.refused[1] + 1 if found.cause == self.refused[0] else 1
            lamp = found.lamp.brightness if found.cause == "lamp" else float("nan")
            x, y = frame.moved_px.tolist() if found.cause == "movement" else (float("nan"), float("nan"))
            doubted = self.doubted | {step.number}
            return replace(state, refused=(found.cause, count), candidate=(lamp, x, y), doubted=doubted)
        state = replace(state, refused=("", 0), candidate=(float("nan"),) * 3, first=self.first or frame.measured)
        if state.founding:
            begun_with = step.number if state.begun_with is None else state.begun_with
            doubted = state.doubted - {step.number}
            state = replace(state, doubted=doubted, begun_with=begun_with, first_frames=(*state.first_frames, seen))
        if step.kind == "light" and not state.doubted:
            state = replace(state, founding=False, first_frames=(), restarts=0)
        if step.kind != "dark":
            # After a step of the lamp nothing before it counts any more.
            leaning = Leaning() if found.lamp.stepped or state.rested else state.leaning.then(found.lamp.leaning)
            state = replace(state, rested=False, leaning=leaning)
        steady = float(np.hypot(*(frame.moved_px - np.array(self.candidate[1:])))) <= limits.STEADY_PX
        if not np.isnan(frame.moved_px).any() and (self.moved_px is None or self.rested or steady):
            state = replace(state, moved_px=frame.moved_px)
        if frame.anchor is not None:
            state = state._anchored(frame.anchor)
        state = state._referenced(step, frame)
        # A frame that makes the basis has been learnt from with it.
        if found.light is not None and self.modelled and state.modelled and step.kind != "dark":
            model = state.model.stepped(found.lamp.brightness) if found.lamp.stepped else state.model
            state = replace(state, model=model.learn(found.light.amounts, codes, found.light.covariance))
        return state

    def without_white(self) -> ProjectorModel | None:
        """Return what the first frames say of the projector without the white one; None where they are too few."""
        others = [one for one in self.first_frames if any(one.codes) and min(one.codes) < 255]
        if self.basis is None or sum(min(one.codes) > 0 for one in others) < _GREYS:
            return None
        model = ProjectorModel.unknown()
        for one in others:
            light = self.basis.light(one.measured)
            model = model.learn(light.amounts, one.codes, light.covariance)
        return model

    def _anchored(self, anchor: Anchor) -> JudgeState:
        """Return what is known where the chart lies elsewhere: pictures of another place are no basis any more."""
        again = self.anchor is not None
        return replace(
            self,
            anchor=anchor,
            moved_px=np.zeros(2),
            moved_on=again,
            basis=None if again else self.basis,
            primaries=(None, None, None) if again else self.primaries,
        )

    def _referenced(self, step: SessionStep, frame: Frame) -> JudgeState:
        """Return what is known with a frame that later ones are compared with."""
        measured = frame.measured
        state = self
        if step.kind in REFERENCES:
            state = replace(state, untold=frozenset())
        if step.kind == "white":
            state = replace(state, white=measured, first_white=self.first_white or frame, moved_on=False)
        if step.kind == "dark":
            state = replace(state, dark=measured, first_dark=self.first_dark or measured)
            if state.basis is not None and state.basis.of_primaries:
                state = replace(state, basis=state.basis.with_dark(measured))
        primary = primary_of(step.colour.codes)
        if is_brightest_grey(step):
            state = replace(state, first_grey=self.first_grey or frame)
        if not self.modelled and (step.kind == "white" or (step.kind == "response" and primary is None)):
            state = replace(state, witness=measured)
        if step.kind == "response" and primary is not None and len(measured.strips):
            of: list[Measured | None] = list(state.primaries)
            of[primary] = measured
            state = replace(state, primaries=(of[0], of[1], of[2]))
        return state._based(step)

    def _based(self, step: SessionStep) -> JudgeState:
        """Return what is known with the best basis that the frames so far give."""
        red, green, blue = self.primaries
        if self.dark is None:
            return self
        if self.basis is None or not self.basis.of_primaries:
            if red is not None and green is not None and blue is not None:
                basis = Basis.between((red, green, blue), self.dark)
                model = self.model
                for number, frame in enumerate((red, green, blue)):
                    light = basis.light(frame)
                    model = model.learn(light.amounts, _primary_codes(number), light.covariance)
                if self.white is not None and not self.moved_on:
                    light = basis.light(self.white)
                    model = model.learn(light.amounts, (255, 255, 255), light.covariance)
                return replace(self, basis=basis, model=model)
            if self.white is not None and step.kind in REFERENCES:
                return replace(self, basis=Basis.of_white(self.white, self.dark))
        return self


def is_brightest_grey(step: SessionStep) -> bool:
    """Return whether a step shows grey at `TOP`, with which a run that is taken up again begins."""
    return step.kind == "response" and step.colour.codes == (TOP, TOP, TOP)


def _primary_codes(primary: int) -> Codes:
    """Return the codes that show primary 0, 1 or 2 alone at `TOP` (`experiment.session.records`)."""
    return PRIMARIES[primary].codes


def primary_of(codes: Codes) -> int | None:
    """Return which primary codes show alone at `TOP`; None if they show anything else."""
    return next((number for number in range(3) if codes == _primary_codes(number)), None)
