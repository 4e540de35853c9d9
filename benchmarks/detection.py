"""What the live judge sees, and what it takes for a fault that is none: `python -m benchmarks.detection`.

Four tables, as Markdown. Detection: each disturbance and size, tried in several simulated rooms at several lights,
deep blues, whites and dark frames among them: how often it was refused at its frame, at the next, or not at all, and by
which causes. False alarms: frames refused in undisturbed sessions, a room each, some with a lamp that drifts and a
sensor that warms up, some with projectors that do not add, remember the picture before, or with other light that
flickers. Neighbours: which of the plan's 707 lights could stand for one another without being told.

Frames are simulated (`sim.world`): a small body and chart for most, an EOS 550D before the whole chart with ``--full``.
The disturbances are those of `benchmarks.disturbance_trials`, the undisturbed sessions of `benchmarks.false_alarms`.
The fourth table has whole runs in which causes come and go (`benchmarks.troubled_runs`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from acquisition.judge import limits
from acquisition.judge.state import ProjectorModel
from benchmarks.disturbance_trials import detection
from benchmarks.false_alarms import false_alarms, odd_worlds
from benchmarks.judged_labs import Lab, lab_of, rooms
from benchmarks.troubled_runs import causes
from experiment.chart.layout import design_chart
from experiment.lights import Illuminant
from sim.world.world import Room


def neighbours(model: ProjectorModel, plan: Sequence[Illuminant]) -> tuple[int, int, list[str]]:
    """Return how many lights have another, and how many the next of the list, that they cannot be told from; and which.

    A light that is seen instead is told if it would be on average: by `limits.STALE_SIGMAS` and `STALE_ADVANTAGE`.
    """
    codes = [light.colour for light in plan]
    amounts = np.array([model.predict(one).amounts for one in codes])
    least = max(limits.STALE_SIGMAS, limits.STALE_ADVANTAGE**0.5)

    def told(seen: int, ordered: int) -> bool:
        fit = model.compare(amounts[seen], codes[ordered])
        return float(np.hypot(fit.distance, fit.brightness / fit.brightness_sd)) > least

    pairs: set[tuple[int, int]] = set()
    for k in range(len(plan)):
        near = np.argsort(np.linalg.norm(amounts - amounts[k], axis=1))[1:9].tolist()
        pairs |= {(min(k, n), max(k, n)) for n in near if codes[n] != codes[k] and not (told(n, k) and told(k, n))}
        pairs |= {(min(k, n), max(k, n)) for n in near if codes[n] == codes[k]}
    lights = {one for pair in pairs for one in pair}
    following = sum((k, k + 1) in pairs for k in range(len(plan) - 1))
    return len(lights), following, [f"{tuple(plan[a].colour)} and {tuple(plan[b].colour)}" for a, b in sorted(pairs)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 0, or 1 where a run did not end, or go on, as the how-to says."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detection", description=__doc__)
    parser.add_argument("--rooms", type=int, default=4, metavar="N", help="small rooms for the detection")
    parser.add_argument(
        "--tries", type=int, default=8, metavar="N", help="frames that a disturbance is tried at, a room"
    )
    parser.add_argument("--sessions", type=int, default=100, metavar="N", help="undisturbed sessions, a fifth drifting")
    parser.add_argument("--lights", type=int, default=36, metavar="N", help="lights of such a session")
    parser.add_argument("--full", action="store_true", help="an EOS 550D before the whole chart, too")
    parser.add_argument("--frames-only", action="store_true", help="leave out the whole runs that go wrong")
    options = parser.parse_args(arguments)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        labs: list[Lab] = []
        for seed in range(options.rooms):
            room, more = rooms(3 * seed + 1)
            labs.append(lab_of(folder, room, **more))
        if options.full:
            labs.append(lab_of(folder, Room(seed=9, wheel_hz=60), "EOS 550D", design_chart(5, "A0")))
        for number, lab in enumerate(labs):
            for step, said in lab.session(options.lights, 12, number):
                if not said.accepted:
                    print(f"room {number}: {step.stem} refused: {said.reason}", file=sys.stderr)
        print("| disturbance | size | tried | at the frame | at the next | missed | misnamed | causes |")
        print("|---|---|---|---|---|---|---|---|")
        for (what, size), tally in detection(labs, options.tries).items():
            named = ", ".join(f"{one} {count}" for one, count in tally.causes.most_common())
            tried = tally.at_once + tally.next + tally.missed
            counts = f"{tried} | {tally.at_once} | {tally.next} | {tally.missed} | {tally.misnamed}"
            print(f"| {what} | {size} | {counts} | {named} |")
        if labs:
            lights, following, which = neighbours(labs[0].judge.state.model, labs[0].plan)
            scatter = labs[0].judge.state.model
            print(
                f"\nScatter learnt in the first room: {scatter.chroma_sd:.2%} of colours, {scatter.brightness_sd:.2%}."
            )
            print(f"{lights} of {len(labs[0].plan)} lights have another that could stand for them unnoticed;")
            print(f"{following} of them are followed by it in the list: {'; '.join(which)}")
        if options.sessions:
            refused, frames, found = false_alarms(folder, options.sessions, options.lights, options.sessions // 5)
            print(
                f"\nFalse alarms: {refused} of {options.sessions} sessions, {sum(found.values())} of {frames} frames",
                end="",
            )
            print(f" ({', '.join(f'{one} {count}' for one, count in found.items())})" if found else "")
            print("\n| world | frames | refused | causes | limit of light at the end |\n|---|---|---|---|---|")
            for what, count, wrong, named, limit in odd_worlds(folder, options.lights):
                print(f"| {what} | {count} | {wrong} | {dict(named) or ''} | {limit} |")
    as_said = True
    if not options.frames_only:
        print("\nCauses that come and go, in whole runs:\n")
        as_said = causes()
    print(f"\n{time.monotonic() - began:.0f} s")
    return int(not as_said)


if __name__ == "__main__":
    sys.exit(main())
