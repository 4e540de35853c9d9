"""Plans, waits, retakes and reports of runs, number by number."""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from acquisition.run import pipeline, plan
from acquisition.run.devices import ENGRAVED_S, holds_whole_turns, period_s, require_whole_turns, wheel_of
from acquisition.run.plan import Answers, frame_bytes, make_plan, needed_bytes
from acquisition.run.run import take_session
from drivers.camera import Supplies
from drivers.presenter import BLACK, Colour
from experiment.config import CameraSettings, JudgeSettings, ProjectorCable
from experiment.session.folder import Session
from experiment.session.records import Check, Judgement, SessionStep
from foundation.errors import CropError, DeviceError, DeviceFault, LinkClosed
from tests.acquisition.run.mishaps import TroubledLab, new_session
from tests.acquisition.run.scripted import GLARE, NIGHT, TURNED, Lab
from tests.acquisition.run.test_devices import PausedRoom
from tests.acquisition.run.test_pipeline import FOUR, PATIENT, ScriptedJudge, queue_of, refused, take
from tests.acquisition.run.test_plan import EOS, GB, SPEEDS, settings_with, work_of
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


def test_plans_runs(pinned: Pinned) -> None:
    chance, plans = random.Random(5), list[Any]()
    supplies = [
        None,
        Supplies(0.25, None, None, saves_to_host=True),
        Supplies(0.26, mains=False, card_free_bytes=10**9, saves_to_host=False),
        Supplies(0.2, mains=True, card_free_bytes=10**12, saves_to_host=False),
        Supplies(None, None, 3 * 10**9, saves_to_host=False),
    ]
    bodies = [None, EOS, *(replace(EOS, model=model) for model in ("ILCE-7M4", "NIKON D850", "Canon EOS R5", "X"))]
    rigs: list[dict[str, Any]] = [
        {},
        {"camera": {"shutter_s": 0.7}, "sequence": {"settle_s": 10.1, "warm_up_s": 299}},
        {"camera": {"shutter_s": 2.0}, "sequence": {"settle_s": 10.0, "warm_up_s": 300, "order": "listed"}},
        {"lab": {"projector": {"control": "none", "colour_wheel_hz": 60}}, "sequence": {"seed": 7}},
        {"sequence": {"notify": "nobody-here", "warm_up_s": 0}, "notify": {"alive": "https://example.org/x"}},
    ]
    for number in range(18):
        settings = settings_with(**chance.choice(rigs))
        done_count = chance.choice((0, 0, 50, 59, 60, 61, 110))
        largest, frame_s = chance.choice((None, 25_000_000)), chance.choice((None, 3.25))
        work = work_of(settings, done_count, frame_bytes=largest, frame_s=frame_s)
        if number % 9 == 0:
            steps = tuple(replace(step, colour=BLACK) if step.illumination == 3 else step for step in work.steps)
            work = replace(work, steps=steps)
        answers = Answers(
            camera=chance.choice(bodies),
            offered_s=chance.choice(((), SPEEDS, (2.02, 0.505), (0.71, 1.99))),
            supplies=chance.choice(supplies),
            projector=chance.choice(("", "Epson")),
            lit=chance.choice((None, True, False)),
            unasked=chance.choice(((), ("this",))),
        )
        free_bytes, simulated_bytes = chance.choice((GB, 3 * GB, 5 * GB, 10**12)), chance.choice((None, 10**6))
        run_plan = make_plan(settings, work, answers, free_bytes, simulated_bytes)
        numbers = [run_plan.frame_bytes, run_plan.frame_s, run_plan.warm_up_s, run_plan.time_s, run_plan.needed_bytes]
        plans.append([numbers, len(run_plan.faults)])
    models = [frame_bytes(None, model).value for model in ("", "ILCE-7M4", "CroP Test", *plan.MEGAPIXELS)]
    needs = [needed_bytes(frames, size) for frames in (0, 1, 766) for size in (1, 25e6)]
    offered = [plan.is_offered(time, SPEEDS) for time in (0.5, 0.505, 0.506, 0.495, 0.494, 1.01, 1.02)]
    pinned("plans of runs", [plans, models, needs, offered])


def test_counts_turns_in_shutter_times(pinned: Pinned) -> None:
    wheels = (24.0, 50.0, 59.94, 60.0, 120.0, 180.0)
    turns = {str(hz): [time for time in ENGRAVED_S if holds_whole_turns(time, 1 / hz)] for hz in wheels}
    fractions = [
        [n, holds_whole_turns(n / 60, 1 / 60)] for n in (0.4, 0.5, 0.994, 0.995, 1.005, 1.0051, 30.14, 30.16, 300.9)
    ]
    assert not holds_whole_turns(1e-5, 1 / 60), "next to nothing is no turn, however near to a whole number of them"
    is_accepted: list[bool] = []
    for time, cable in product(
        (0.5, 0.3, 0.01, 1 / 60, 31.0, 0.5026),
        (ProjectorCable(), ProjectorCable(colour_wheel_hz=180), ProjectorCable(refresh_hz=50)),
    ):
        try:
            require_whole_turns(CameraSettings(shutter_s=time), cable)
            is_accepted.append(True)
        except CropError:
            is_accepted.append(False)
    plain, wheel = settings_with(), settings_with(lab={"projector": {"colour_wheel_hz": 90}})
    rigs = [plain, wheel, plain.model_copy(update={"rig": "simulated"})]
    pinned(
        "whole turns",
        {
            "turns": turns,
            "odd": fractions,
            "accepted": is_accepted,
            "rigs": [[wheel_of(rig), period_s(rig)] for rig in rigs],
            "times": ENGRAVED_S,
        },
    )


def test_waits_for_faults(pinned: Pinned) -> None:
    faults = [DeviceError("covered by 3 windows"), LinkClosed("nothing at 10.0.0.1"), DeviceFault("off; switch it on")]
    waits: dict[str, Any] = {}
    for limit, takes, pattern in product(
        (0.0, 60.0, 600.0, math.inf), (0.0, 2.5), ((0.9,), (1.0, 30.0), (0.5, 4.0, 9.0), (45.0, 80.0), (1e9,))
    ):
        if math.inf in (limit,) and max(pattern) > 1e8:
            continue
        room = PausedRoom(limit)
        retry, ended = room.retry, False

        def fault(now: float, pattern: tuple[float, ...] = pattern) -> CropError | None:
            return next((faults[n] for n, end in enumerate(pattern) if now < end), None)

        try:
            for repetition in range(2):
                retry.attempt(
                    room.broken(lambda now, repetition=repetition: fault(now - 100 * repetition), takes), "the camera"
                )
                retry.accepted()
                room.clock.sleep(max(100 * (repetition + 1) - room.clock.monotonic(), 0))
            pause = retry.pause("frames")
            for _ in range(4):
                pause.back_off(DeviceError("late"))
            pause.over()
        except CropError:
            ended = True
        times = [len(room.beats), len(room.idled), len(room.tries), room.tries[-1], room.clock.monotonic()]
        waits[f"{limit:g} s, {takes:g} s, {pattern}"] = [*times, ended]
    pinned("waits for what fails", waits)


def test_orders_steps(pinned: Pinned) -> None:
    chance, orders = random.Random(2), list[Any]()
    for number in range(60):
        done_numbers = set(chance.sample(range(10), chance.randrange(9)))
        bad = {n: chance.randrange(1, 5) for n in chance.sample(range(12), chance.randrange(4))}
        queue = queue_of(done_numbers, chance.choice((1, 2, 3)))
        if number % 3 == 0:
            queue.void(chance.sample(sorted(done_numbers), len(done_numbers) // 2), "doubtful")
        order = take(queue, bad)
        orders.append([*order, len(queue), queue.is_stuck])
    pinned("steps in their order", orders)


def test_reports_accepted_changes(pinned: Pinned) -> None:
    grey, counts = Colour(250, 250, 250), list[Any]()
    first, light = SessionStep(3, "response", None, grey), SessionStep(5, "light", 0, grey)
    dark = SessionStep(1, "dark", None, BLACK)
    steps = (first, light, dark, replace(first, number=9))
    for step, value in product(steps, (-2.0, -1.0, -0.2, 0.0, 0.2, 0.5, 0.51, 1.0, 1.01)):
        for name in ("movement", "off_brightness", "leak_share"):
            judged = Judgement((Check(name, value, -1.5, 1.5),))
            counts.append(len(list(pipeline._accepted_changes(step, judged, steps, JudgeSettings()))))
    pinned("changes that a run follows", counts)


LASTS = refused("moved", lasting=True)
SEEDS = (29, 30, 34, 37, 41)  # runs with at least five faults, none of them of the disk

SCRIPTS: dict[str, tuple[dict[int, bytes | Exception], dict[int, Judgement]]] = {
    "calm": ({}, {}),
    "dark, glaring and turned": ({2: NIGHT, 4: GLARE, 7: TURNED}, {}),
    "of faults": ({1: DeviceFault("no lens"), 3: LinkClosed("the cable is out"), 5: DeviceError("busy")}, {}),
    "of refusals": ({}, {2: refused("off"), 5: refused("off", voids=True), 9: refused("off")}),
    "of what lasts": ({}, {3: LASTS, 4: LASTS, 8: refused("x", voids=True)}),
    "given up": ({}, {n: refused("never") for n in range(2, 30)}),
}


def journal_of(session: Session) -> dict[str, Any]:
    """Return the times and verdicts of all attempts, and the number of each event."""
    attempts, events = session.journal.attempts(), session.journal.events()
    verdicts: dict[str, list[int]] = {}
    for one in attempts:
        verdicts.setdefault(str(one.verdict), []).append(one.step)
    return {
        "begun": [(one.started_at - attempts[0].started_at).total_seconds() for one in attempts],
        **verdicts,
        "events": Counter(one.what for one in events),
    }


@pytest.mark.parametrize("name", SCRIPTS)
def test_takes_a_session(name: str, tmp_path: Path, pinned: Pinned) -> None:
    script, judged = SCRIPTS[name]
    lab = Lab(tmp_path / "session", dict(script), FOUR, 2)
    judge = ScriptedJudge(dict(judged)) if judged else None
    try:
        outcome = take_session(lab.session, lab.devices, PATIENT, judge)
        ended: Any = {"complete": outcome.complete, "refused": len(outcome.refused), "doubts": len(outcome.doubts)}
    except CropError:
        ended = {"failed": 1}
    lab.session.close()
    with Session.open(tmp_path / "session") as session:
        pinned(f"a run, {name}", {**ended, **journal_of(session)})


@pytest.mark.parametrize("seed", SEEDS)
def test_takes_sessions_with_mishaps(seed: int, tmp_path: Path, pinned: Pinned) -> None:
    lab = TroubledLab(seed)
    with new_session(tmp_path / "session") as session:
        ended = lab.take(session)
        outcome = {"failed": 1} if isinstance(ended, CropError) else {"refused": len(ended.refused)}
        pinned(f"a run with mishaps, {seed}", {**outcome, **journal_of(session)})
