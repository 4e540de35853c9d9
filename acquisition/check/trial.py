"""Trial session of `acquire check`: a temporary session of about 14 frames, measured like any session.

It has white and dark frames, the three primaries, a grey, and the darkest illuminant of the plan.
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
from experiment.lights import Illuminant
from experiment.measures.frame import measure
from experiment.session.folder import Session
from experiment.session.records import MIDDLE, FrameKind, Judgement, SessionStep
from foundation.colorimetry import decode_srgb
from foundation.errors import FormatError, InputError, QualityError, RegistrationError

WHITES = 3  # Number of white frames at the start, and again at the end. Their scatter shows the flicker of the lamp.

SERIES = 8  # Number of shutter times of a linearity series.

PRIMARIES = {"red": Colour(255, 0, 0), "green": Colour(0, 255, 0), "blue": Colour(0, 0, 255)}

# Colours of the trial illuminants, in addition to the darkest of the plan.
_COLOURS = {"white": WHITE, **PRIMARIES, "grey": Colour(MIDDLE, MIDDLE, MIDDLE)}


@dataclass(frozen=True, eq=False)
class Trial:
    """Measurements of trial frames.

    - `white`: the first white frame.
    - `table`: measurements; None if the chart was not detected or cannot be used.
    - `verdict`: the judged figures that trial frames can measure.
    - `dark_percent`: light in the dark frames, percent of white, as `acquire run` measures it.
    - `trouble`: the reason for a missing `table`; "" if there is a table.
    - `series_trouble`: the reason for an unusable linearity series; "" if it is usable or was not requested.
    """

    white: Mosaic
    table: TableMeasurements | None
    verdict: Verdict
    dark_percent: float = 0.0
    trouble: str = ""
    series_trouble: str = ""

    @property
    def not_known(self) -> tuple[str, ...]:
        """Names of the figures that only a session can measure."""
        measured = {row.figure.name for row in self.verdict.rows}
        return tuple(figure.name for figure in FIGURES if figure.name not in measured)


def trial_lights(plan: Sequence[Illuminant], primaries: npt.NDArray[np.float64]) -> tuple[Illuminant, ...]:
    """Return the illuminants of a trial: white, the primaries, grey, and the darkest of the plan.

    `primaries`: (3, 3) counts of R, G and B under red, green and blue of the projector, which predict the counts of
    any illuminant. The darkest illuminant has the fewest counts in its strongest channel, as in `darkest_counts`.
    """
    colours = dict(_COLOURS)
    if plan:
        counts = decode_srgb(np.array([light.colour for light in plan]) / 255) @ primaries
        darkest = plan[int(np.argmin(counts.max(axis=1)))].colour
        if darkest not in colours.values():
            colours["darkest"] = darkest
    return tuple(
        Illuminant(index, "uniform", None, colour, name) for index, (name, colour) in enumerate(colours.items())
    )


def trial_steps(lights: Sequence[Illuminant]) -> tuple[SessionStep, ...]:
    """Return the plan of a trial: white and dark frames, then illuminants, then white and dark frames again."""
    references: list[tuple[FrameKind, int | None, Colour]] = [("white", None, WHITE)] * WHITES
    references.append(("dark", None, BLACK))
    lit: list[tuple[FrameKind, int | None, Colour]] = [("light", light.index, light.colour) for light in lights]
    planned = [*references, *lit, *references]
    return tuple(SessionStep(number, *step) for number, step in enumerate(planned))


def series_times(times_s: Sequence[float], white_s: float, white_level: float) -> list[float]:
    """Return rising shutter times at which white has 6 to 94 % of saturation.

    `white_s`, `white_level`: a shutter time, s, and the level of white at this time, as a share of saturation.
    """
    usable_s = [time for time in times_s if 0.06 <= white_level * time / white_s <= 0.94]
    if len(usable_s) <= SERIES:
        return usable_s
    targets_s = np.geomspace(usable_s[0], usable_s[-1], SERIES)
    return sorted({min(usable_s, key=lambda time: abs(np.log(time / target_s))) for target_s in targets_s.tolist()})


def take_trial(
    camera: Photographer, session: Session, shutter_s: float, series_s: Sequence[float], series: Path
) -> None:
    """Take the frames of the trial session, then white frames at rising shutter times into the folder `series`."""
    for step in session.steps:
        attempt = session.journal.begin(step, f"frames/{step.stem}", camera.now())
        received = session.receive(step.stem, lambda stream, step=step: camera.capture(step.colour, shutter_s, stream))
        session.journal.commit(attempt, received, Judgement(()), exposure_s=shutter_s, ended_at=camera.now())
    for number, seconds in enumerate(series_s):
        with (series / str(number)).open("wb") as stream:
            camera.capture(WHITE, seconds, stream)


def measure_trial(session: Session, saturation: Saturation, corners: Corners | None, series: Path | None) -> Trial:
    """Measure the trial frames; `series` is the folder of a linearity series, or None."""
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
    # White without dark light is the reference, as in `acquire run`.
    levels = [dark_level(tiles, white_scale(lit - dark[0])) for tiles in dark]
    return Trial(white, result.figures, Verdict(rows), max(levels, default=0.0))


def _tiles(mosaic: Mosaic) -> npt.NDArray[np.float64]:
    return measure(mosaic, frame_black(mosaic)).tiles
