"""Frames on their way to the disk: one thread that flushes, hashes, renames and judges them in the order of taking.

The thread touches no device and no journal: it is handed a file that the camera has filled, and gives back what lies on
the disk and what the judge says of it. The order on the disk is write, flush, rename; the journal follows when the main
thread collects the result.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Self

from drivers.camera import Camera, CapturedFrame
from experiment.session.folder import IncomingFile, ReceivedFile, Session
from experiment.session.plan import SessionStep
from experiment.session.records import Check, FrameJudge, Judgement, OutlastsPauses, preview_path
from foundation.errors import CropError, DeviceError
from foundation.files import write_whole


@dataclass(frozen=True)
class FilledFile:
    """A raw file that the camera has written, still under its hidden name."""

    incoming: IncomingFile
    captured: CapturedFrame


@dataclass(frozen=True)
class Saved:
    """A raw file that is complete on the disk, and what was seen in it.

    - `save_s`, `judge_s`: seconds of this machine's time that hashing, flushing and renaming took, and judging.
    - `preview_fault`: why its preview could not be written; empty where it was, or there is none.
    """

    received: ReceivedFile
    judgement: Judgement
    save_s: float
    judge_s: float
    preview_fault: str = ""


def download(session: Session, stem: str, camera: Camera) -> FilledFile:
    """Let the camera write the frame exposed last into `frames/`, under a hidden name."""
    incoming = session.incoming(stem)
    try:
        captured = camera.download(incoming.stream)
        size = incoming.stream.seek(0, 2)
        if size != captured.size or size == 0:
            # Found here and not when the file is completed: the body may hold the frame still.
            raise DeviceError(f"{captured.name}: the camera says {captured.size} bytes, {size} arrived")
    except BaseException:
        with incoming:
            raise
    return FilledFile(incoming, captured)


class Saver:
    """The thread that completes files and judges them, one after another; use it in a `with` block.

    At its end it waits for what was handed to it: a file that the camera has given is completed, whatever happens.
    """

    def __init__(self, session: Session, judge: FrameJudge) -> None:
        self._session = session
        self._judge = judge
        self._thread = ThreadPoolExecutor(1, "saving")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(wait=True)

    def submit(self, filled: FilledFile, step: SessionStep, device_checks: tuple[Check, ...]) -> Future[Saved]:
        """Hand over a file; the result comes when all before it have."""
        return self._thread.submit(self._save, filled, step, device_checks)

    def after_pause(self) -> None:
        """Tell the judge of a pause, if it wants to know; every file that was handed over must be judged."""
        if isinstance(self._judge, OutlastsPauses):
            self._judge.after_pause()

    def _save(self, filled: FilledFile, step: SessionStep, device_checks: tuple[Check, ...]) -> Saved:
        begun = time.perf_counter()
        received = filled.incoming.complete(filled.captured)
        saved = time.perf_counter()
        judgement, preview_fault = Judgement(device_checks), ""
        if judgement.accepted:
            seen = self._judge.judge(received.path, step)
            judgement = replace(seen, checks=(*device_checks, *seen.checks), preview=b"")
            if seen.preview:
                # It is derived and may be lost; flushing it would cost the devices' thread as much as a row.
                try:
                    write_whole(preview_path(self._session.folder, received.path.name), seen.preview)
                except CropError as error:
                    preview_fault = str(error)
        return Saved(received, judgement, saved - begun, time.perf_counter() - saved, preview_fault)
