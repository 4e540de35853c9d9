"""The trial set: a session of a dozen frames, taken into a folder that is thrown away, and measured as any session is.

White several times, dark, the primaries, grey, and the light of the plan that gives the fewest counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.check.exposure import Photographer, Saturation
from acquisition.judge.judge import dark_level, white_scale
from calibration.figures.all_figures import FIGURES
from calibration.measurements import TableMeasurements
from calibration.pipeline.build import judge_trial
from calibration.pipeline.frames import PAPER_OPTIONS
from calibration.verdict import Verdict
from drivers.presenter import BLACK, WHITE, Colour
from drivers.raw.rawfile import Mosaic, frame_black, read_raw
from experiment.framing.field import Corners
from experiment.lights import Illumination
from experiment.measures.frame import measure
from experiment.session.folder import Session
from experiment.session.records import MIDDLE, FrameKind, Judgement, SessionStep
from foundation.colorimetry import decode_srgb
from foundation.errors import FormatError, InputError, QualityError, RegistrationError

WHITES = 3  # White frames before the lights, and as many after them: their spread is the flicker of the light

SERIES = 8  # Shutter times of a series of linearity

PRIMARIES = {"red": Colour(255, 0, 0), "green": Colour(0, 255, 0), "blue": Colour(0, 0, 255)}

# The lights of a trial by name, besides the plan's darkest.
_COLOURS = {"white": WHITE, **PRIMARIES, "grey": Colour(MIDDLE, MIDDLE, MIDDLE)}


@dataclass(frozen=True, eq=False)
class Trial:
    """Trial frames as measured.

    - `white`: the first white frame.
    - `table`: their measurements; None if the chart was not found, or cannot be used.
    - `verdict`: the figures that trial frames show, judged.
    - `dark_percent`: the light of the dark frames as the live judge measures it, of white.
    - `trouble`: why there are no measurements; "" if there are.
    - `series_trouble`: why a series of exposures shows nothing; "" if it does, or none was asked for.
    """

    white: Mosaic
    table: TableMeasurements | None
    verdict: Verdict
    dark_percent: float = 0.0
    trouble: str = ""
    series_trouble: str = ""

    @property
    def not_known(self) -> tuple[str, ...]:
        """Names of the figures that only a session shows."""
        known = {row.figure.name for row in self.verdict.rows}
        return tuple(figure.name for figure in FIGURES if figure.name not in known)


def trial_lights(plan: Sequence[Illumination], primaries: npt.NDArray[np.float64]) -> tuple[Illumination, ...]:
    """Return the lights of a trial: white, the primaries, grey, and the darkest light of the plan.

    `primaries`: (3, 3) counts of R, G and B under the projector's red, its green and its blue, which predict those of a
    light. The darkest has the fewest in its strongest channel, as in `darkest_counts`.
    """
    colours = dict(_COLOURS)
    if plan:
        counts = decode_srgb(np.array([light.colour for light in plan]) / 255) @ primaries
        darkest = plan[int(np.argmin(counts.max(axis=1)))].colour
        if darkest not in colours.values():
            colours["darkest"] = darkest
    return tuple(
        Illumination(index, "uniform", None, colour, name) for index, (name, colour) in enumerate(colours.items())
    )


def trial_steps(lights: Sequence[Illumination]) -> tuple[SessionStep, ...]:
    """Return the plan of a trial."""
    around: list[tuple[FrameKind, int | None, Colour]] = [("white", None, WHITE)] * WHITES
    around.append(("dark", None, BLACK))
    lit: list[tuple[FrameKind, int | None, Colour]] = [("light", one.index, one.colour) for one in lights]
    shown = [*around, *lit, *around]
    return tuple(SessionStep(number, *step) for number, step in enumerate(shown))


def series_times(times_s: Sequence[float], white_s: float, white_level: float) -> list[float]:
    """Return the shutter times of a series in which white goes from 6 to 94 % of saturation, rising.

    `white_s`, `white_level`: a shutter time, and white's share of saturation at it.
    """
    able = [time for time in times_s if 0.06 <= white_level * time / white_s <= 0.94]
    if len(able) <= SERIES:
        return able
    wanted = np.geomspace(able[0], able[-1], SERIES)
    return sorted({min(able, key=lambda time: abs(np.log(time / each))) for each in wanted.tolist()})


def take_trial(
    camera: Photographer, session: Session, shutter_s: float, series_s: Sequence[float], series: Path
) -> None:
    """Take the frames of a trial into its session, and a series of white at rising shutter times into a folder."""
    for step in session.steps:
        attempt = session.journal.begin(step, f"frames/{step.stem}", camera.now())
        received = session.receive(step.stem, lambda stream, step=step: camera.capture(step.colour, shutter_s, stream))
        session.journal.commit(attempt, received, Judgement(()), exposure_s=shutter_s, ended_at=camera.now())
    for number, seconds in enumerate(series_s):
        with (series / str(number)).open("wb") as stream:
            camera.capture(WHITE, seconds, stream)


def measure_trial(session: Session, saturation: Saturation, corners: Corners | None, series: Path | None) -> Trial:
    """Return what trial frames show."""
    frames = session.frames()
    white = read_raw(session.folder / frames[0].file)
    options = replace(PAPER_OPTIONS, corners=corners)
    try:
        result = judge_trial(session, round(saturation.counts), options, series)
    except (RegistrationError, QualityError, FormatError, InputError) as error:
        if series is not None:
            return replace(measure_trial(session, saturation, corners, None), series_trouble=str(error))
        return Trial(white, None, Verdict(()), trouble=str(error))
    rows = tuple(row for row in result.verdict.rows if row.figure.before_session)
    lit = _tiles(white)
    dark = [_tiles(read_raw(session.folder / frame.file)) for frame in frames if frame.kind == "dark"]
    # From white the live judge subtracts the dark light that it knows: all but in the first dark frame of a session.
    levels = [dark_level(tiles, white_scale(lit - dark[0])) for tiles in dark]
    return Trial(white, result.figures, Verdict(rows), max(levels, default=0.0))


def _tiles(mosaic: Mosaic) -> npt.NDArray[np.float64]:
    return measure(mosaic, frame_black(mosaic)).tiles
