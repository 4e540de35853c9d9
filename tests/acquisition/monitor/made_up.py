"""Session folder of a run, made of numbers without a lab, raw files or a judge."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.layout import A_SERIES_MM, design_chart
from experiment.lights import Illuminant, plan_illuminants, save_illuminants
from experiment.session.journal import JOURNAL_FILE, Journal, ReceivedFile
from experiment.session.records import RESPONSE, Check, Judgement, SessionStep, plan_steps
from foundation.colorimetry import decode_srgb

BEGUN = datetime(2026, 3, 1, 22, 0, tzinfo=UTC)
FRAME_S = 5.0
# Camera RGB of the projector's primaries, in columns: each is visible in more than one channel.
CROSSTALK = np.array([[0.80, 0.15, 0.02], [0.17, 0.75, 0.12], [0.03, 0.10, 0.86]])

LIGHTS = tuple(Illuminant(number, "uniform", None, Colour(255, 40 * number, 0)) for number in range(4))


def jpeg(colour: Sequence[int], text: str = "") -> bytes:
    """Return a small picture of one colour with a line of text."""
    picture = np.full((240, 360, 3), colour[::-1], np.uint8)
    cv2.rectangle(picture, (60, 30), (300, 210), (40, 200, 40), 2)
    cv2.putText(picture, text, (10, 228), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return cv2.imencode(".jpg", picture)[1].tobytes()


@dataclass
class MadeUpRun:
    """Writes the journal of a session as a run does; `clock` is the time of the lab.

    `journal` is open for a run and must be closed.
    """

    folder: Path
    steps: tuple[SessionStep, ...]
    journal: Journal
    clock: datetime = BEGUN
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))
    previews: bool = True

    @classmethod
    def begin(cls, folder: Path, lights: Sequence[Illuminant] = LIGHTS, *, response: bool = False) -> MadeUpRun:
        """Create the folder and the plan."""
        folder.mkdir()
        (folder / "previews").mkdir()
        design_chart(1, A_SERIES_MM["A5"]).save(folder / "chart.json")
        save_illuminants(lights, folder / "illuminations.csv")
        steps = plan_steps(lights, 25, seed=1, response=RESPONSE if response else ())
        Journal.create(folder / JOURNAL_FILE, steps)
        run = cls(folder, steps, Journal.open_for_run(folder / JOURNAL_FILE))
        run.journal.record("camera", "Canon EOS 550D, 1234567890")
        run.journal.record("plan", f"{len(lights)} lights, shuffled, seed 1")
        run.journal.note(run.clock, "start", f"{len(steps)} of {len(steps)} frames to take")
        run.beat("running", f"taking {len(steps)} frames")
        return run

    def beat(self, state: str, sentence: str, within_s: float = 60.0) -> None:
        """Give a sign of life, by the computer's clock."""
        self.journal.beat(state, sentence, datetime.now(UTC) + timedelta(seconds=within_s))  # pyrefly: ignore[bad-argument-type]

    def expose(self, step: SessionStep, try_: int = 1) -> int:
        """Start an attempt; return its number."""
        stem = step.stem if try_ == 1 else f"{step.stem}_try{try_}"
        return self.journal.begin(step, f"frames/{stem}", self.clock)

    def seen(self, step: SessionStep) -> tuple[float, float, float]:
        """Return the RGB counts of the camera under a step's illuminant."""
        linear = decode_srgb([code / 255 for code in step.colour])
        counts = (CROSSTALK @ linear + 0.0005) * 9000 * (1 + self.random.normal(0, 0.0005, 3))
        return float(counts[0]), float(counts[1]), float(counts[2])

    def take(
        self, step: SessionStep, reason: str = "", *, check: str = "off_codes_deg", value: float | None = None
    ) -> int:
        """Take a frame of a step; with a `reason`, `check` refuses it with `value`."""
        tries = self.journal.kept_files(step) + 1
        attempt = self.expose(step, tries)
        self.clock += timedelta(seconds=FRAME_S + float(self.random.normal(0, 0.05)))
        checks = tuple(
            replace(one, value=value, reason=reason) if reason and one.name == check else one
            for one in self._checks(step)
        )
        stem = step.stem if tries == 1 else f"{step.stem}_try{tries}"
        raw = self.folder / "frames" / f"{stem}.cr2"
        raw.parent.mkdir(exist_ok=True)
        raw.write_bytes(b"raw")
        self.journal.commit(
            attempt,
            ReceivedFile(raw, 3, "0" * 64, CapturedFrame(raw.name, 3, self.clock - timedelta(seconds=2))),
            Judgement(checks, self.seen(step)),
            {"settle": 0.2, "expose": 0.55, "download": 0.9, "save": 0.2, "wait": 1.4e-5},
            exposure_s=0.5,
            ended_at=self.clock,
        )
        if self.previews:
            colour = step.colour
            (self.folder / "previews" / f"{stem}.jpg").write_bytes(jpeg(colour, f"{stem} {reason[:24]}"))
        return attempt

    def _checks(self, step: SessionStep) -> tuple[Check, ...]:
        drawn: npt.NDArray[np.float64] = self.random.normal(0, 1, 6)
        number = step.number
        checks = [
            Check("movement", abs(0.02 + 0.01 * float(drawn[0])), None, 0.5, "px"),
            Check("blur", 1.02 + 0.01 * float(drawn[1]), 0.8, 1.25, ""),
            Check("clipping", 0.0, None, 0.1, "%"),
        ]
        if step.kind == "white":
            checks.append(Check("white_drift", -0.002 * number + 0.05 * float(drawn[2]), -3.0, 3.0, "%"))
        elif step.kind == "dark":
            checks.append(Check("leak_share", 4.5 + 0.1 * float(drawn[3]), None, 80.0, "DN"))
            checks.append(Check("dark_drift", 0.04 + 0.004 * float(drawn[4]), None, 0.5, "%"))
        else:
            checks.append(Check("off_codes_deg", abs(0.3 + 0.1 * float(drawn[5])), None, 1.0, "°"))
        checks.append(Check("screen"))
        return tuple(checks)


def whole_night(folder: Path, share: float = 0.6, *, grid: int = 35, previews: bool = True) -> MadeUpRun:
    """Return an open run of the paper's illuminants, `share` of them taken, with the usual events of a night."""
    run = MadeUpRun.begin(folder, plan_illuminants(grid, tuple(range(2000, 10001, 200))), response=True)
    run.previews = previews
    last = int(share * len(run.steps))
    for step in run.steps[:last]:
        if step.number == last // 3:
            reason = "the light is 8.2° from the one ordered, 1° allowed; close what covers the picture"
            run.take(step, reason, value=8.2)
        if step.number == last // 2:
            reason = "the chart has moved by 3.1 px, 0.5 px allowed; find what moved it"
            run.take(step, reason, check="movement", value=3.1)
            failed = run.expose(step, 2)
            run.clock += timedelta(seconds=90)
            run.journal.fail(failed, run.clock, "the camera does not answer; see that it is on and its cable is in")
            run.journal.note(run.clock, "paused", "the camera: it does not answer")
            run.journal.note(run.clock, "resumed", "the camera is ready again")
        run.take(step)
    return run


def closed(run: MadeUpRun) -> closing[Journal]:
    """Return a block after which the run's journal is closed."""
    return closing(run.journal)
