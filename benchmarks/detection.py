"""Detected faults and false alarms of the live judge: `python -m benchmarks.detection`.

It prints four Markdown tables:

- detection: each disturbance and size is tried in several simulated rooms and under several illuminants (also deep
  blue, white and dark frames). The table counts detections in the same frame, in the next frame or never, and the
  causes;
- false alarms: refused frames in undisturbed sessions, one room each. Some rooms have a drifting lamp and a warming
  sensor, or a projector that is not additive, depends on the previous image or flickers;
- neighbours: illuminants of the plan (707) that could replace each other undetected;
- whole runs with intermittent causes (`benchmarks.troubled_runs`).

Frames are simulated (`sim.world`), mostly with a small body and chart; ``--full`` adds an EOS 550D with the whole
chart. Disturbances come from `benchmarks.disturbance_trials`, undisturbed sessions from `benchmarks.false_alarms`.
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
from benchmarks.false_alarms import false_alarms, unusual_worlds
from benchmarks.judged_labs import Lab, lab_of, rooms
from benchmarks.troubled_runs import causes
from experiment.chart.layout import design_chart
from experiment.lights import Illuminant
from sim.world.world import Room


def neighbours(model: ProjectorModel, plan: Sequence[Illuminant]) -> tuple[int, int, list[str]]:
    """Count illuminants that look like another one of the plan, or like the next one, and list the pairs.

    Two illuminants are distinguished if a swap exceeds the limits `limits.STALE_SIGMAS` and `STALE_ADVANTAGE` on
    average.
    """
    codes = [light.colour for light in plan]
    amounts = np.array([model.predict(colour).amounts for colour in codes])
    min_distance = max(limits.STALE_SIGMAS, limits.STALE_ADVANTAGE**0.5)

    def differs(shown_index: int, ordered_index: int) -> bool:
        fit = model.compare(amounts[shown_index], codes[ordered_index])
        return float(np.hypot(fit.distance, fit.brightness / fit.brightness_sd)) > min_distance

    pairs: set[tuple[int, int]] = set()
    for k in range(len(plan)):
        nearest = np.argsort(np.linalg.norm(amounts - amounts[k], axis=1))[1:9].tolist()
        pairs |= {
            (min(k, n), max(k, n)) for n in nearest if codes[n] != codes[k] and not (differs(n, k) and differs(k, n))
        }
        pairs |= {(min(k, n), max(k, n)) for n in nearest if codes[n] == codes[k]}
    ambiguous = {index for pair in pairs for index in pair}
    followed = sum((k, k + 1) in pairs for k in range(len(plan) - 1))
    return (
        len(ambiguous),
        followed,
        [f"{tuple(plan[a].colour)} and {tuple(plan[b].colour)}" for a, b in sorted(pairs)],
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a whole run did not end as documented, else 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detection", description=__doc__)
    parser.add_argument("--rooms", type=int, default=4, metavar="N", help="number of small rooms for the detection")
    parser.add_argument("--tries", type=int, default=8, metavar="N", help="frames per disturbance and room")
    parser.add_argument("--sessions", type=int, default=100, metavar="N", help="undisturbed sessions, 1/5 with drift")
    parser.add_argument("--lights", type=int, default=36, metavar="N", help="illuminants of an undisturbed session")
    parser.add_argument("--full", action="store_true", help="add an EOS 550D with the whole chart")
    parser.add_argument("--frames-only", action="store_true", help="omit the whole runs")
    options = parser.parse_args(arguments)
    start_s = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        labs: list[Lab] = []
        for seed in range(options.rooms):
            room, lab_options = rooms(3 * seed + 1)
            labs.append(lab_of(folder, room, **lab_options))
        if options.full:
            labs.append(lab_of(folder, Room(seed=9, wheel_hz=60), "EOS 550D", design_chart(5, "A0")))
        for number, lab in enumerate(labs):
            for step, judgement in lab.session(options.lights, 12, number):
                if not judgement.accepted:
                    print(f"room {number}: {step.stem} refused: {judgement.reason}", file=sys.stderr)
        print("| disturbance | size | tried | same frame | next frame | missed | wrong cause | causes |")
        print("|---|---|---|---|---|---|---|---|")
        for (label, size), tally in detection(labs, options.tries).items():
            counts_by_cause = ", ".join(f"{cause} {count}" for cause, count in tally.causes.most_common())
            tried = tally.at_once + tally.next + tally.missed
            counts = f"{tried} | {tally.at_once} | {tally.next} | {tally.missed} | {tally.wrong_cause}"
            print(f"| {label} | {size} | {counts} | {counts_by_cause} |")
        if labs:
            lights, followed, pair_names = neighbours(labs[0].judge.state.model, labs[0].plan)
            scatter = labs[0].judge.state.model
            print(f"\nScatter, first room: colour {scatter.chroma_sd:.2%}, brightness {scatter.brightness_sd:.2%}.")
            print(f"{lights} of {len(labs[0].plan)} illuminants could be replaced undetected;")
            print(f"{followed} of them by the next of the plan: {'; '.join(pair_names)}")
        if options.sessions:
            bad, frames, alarms = false_alarms(folder, options.sessions, options.lights, options.sessions // 5)
            print(
                f"\nFalse alarms: {bad} of {options.sessions} sessions, {sum(alarms.values())} of {frames} frames",
                end="",
            )
            print(f" ({', '.join(f'{name} {count}' for name, count in alarms.items())})" if alarms else "")
            print("\n| world | frames | refused | causes | chromaticity limit at the end |\n|---|---|---|---|---|")
            for label, count, refused, counts_by_cause, limit in unusual_worlds(folder, options.lights):
                print(f"| {label} | {count} | {refused} | {dict(counts_by_cause) or ''} | {limit} |")
    as_documented = True
    if not options.frames_only:
        print("\nIntermittent causes in whole runs:\n")
        as_documented = causes()
    print(f"\n{time.monotonic() - start_s:.0f} s")
    return int(not as_documented)


if __name__ == "__main__":
    sys.exit(main())
