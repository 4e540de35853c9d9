"""Progress of `generate`, as a bar on a terminal or as lines in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Final

from foundation.console import shows_progress
from foundation.errors import counted
from foundation.secret_texts import printable

if TYPE_CHECKING:
    from rich.progress import Progress

    from generator.dataset.shards import Callbacks


# Seconds before a bar is shown. Loading the library for bars takes 0.1 s, so short work prints its last line only.
SOON_S: Final = 0.5


@contextmanager
def show_progress(images: int) -> Generator[Callbacks]:
    """Show the number of images, the rate and the remaining time while the block runs.

    A terminal shows a bar. Logs, and work shorter than `SOON_S`, get one line at the end.
    """
    from generator.dataset.shards import SILENT, Callbacks

    if not shows_progress():
        yield SILENT
        return
    with ExitStack() as stack:
        count = _ImageCounter(images, stack)
        try:
            yield Callbacks(on_done=count.count_reused, on_image=count.advance, on_skip=count.skip, on_wait=count.warn)
        finally:
            count.end()


class _ImageCounter:
    """Counts of images, and their display."""

    def __init__(self, total: int, stack: ExitStack) -> None:
        self._total = total
        self._stack = stack
        self._made = self._reused = self._reported = 0
        self._start = time.monotonic()
        self._bar: Progress | None = None

    def count_reused(self, images: int) -> None:
        """Count images of an earlier run; a negative number subtracts images that must be made again."""
        self._total -= images
        self._reused += images

    def advance(self) -> None:
        """Count one new image."""
        self._made += 1
        if not self._reported:
            self._report_reused()
        if self._bar is None and sys.stderr.isatty() and time.monotonic() - self._start > SOON_S:
            self._bar = self._stack.enter_context(_bar())
            self._bar.add_task("images", total=self._total, rate="", left="")
        self._update()

    def skip(self, name: str, reason: str, images: int) -> None:
        """Report a picture that cannot be read."""
        self._total -= images
        self.warn(f"skipped {name}: {reason}")
        self._update()

    def warn(self, sentence: str) -> None:
        """Print a warning."""
        self._print(sentence, style="yellow")

    def end(self) -> None:
        """Print the final counts."""
        self._report_reused()
        if self._bar is None:
            print(f"images {self._made}/{self._total} {self._rate():.1f}/s", file=sys.stderr)

    def _report_reused(self) -> None:
        # Unfinished shards are resumed one after another, so the number of reused images may rise during the run.
        if self._reused > self._reported:
            self._print(
                f"{counted(self._reused, 'image exists', 'images exist')} from an earlier run"
                + (" in total" if self._reported else "")
            )
            self._reported = self._reused

    def _rate(self) -> float:
        # The mean over the whole run, because a cluster reports all images of a shard at once.
        return self._made / max(time.monotonic() - self._start, 0.1)

    def _update(self) -> None:
        if self._bar is None or not self._made:
            return
        rate = self._rate()
        remaining = timedelta(seconds=round(max(self._total - self._made, 0) / rate))
        task = self._bar.task_ids[0]
        self._bar.update(task, completed=self._made, total=self._total, rate=f"{rate:.1f}/s", left=f"{remaining} left")

    def _print(self, sentence: str, style: str | None = None) -> None:
        # Names of foreign files may contain control characters.
        sentence = printable(sentence)
        if self._bar is not None:
            self._bar.console.print(sentence, style=style, markup=False, highlight=False)
        elif style and sys.stderr.isatty():
            from rich.console import Console

            Console(stderr=True).print(sentence, style=style, markup=False, highlight=False)
        else:
            print(sentence, file=sys.stderr)


def _bar() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        TextColumn("[progress.description]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[left]}"),
    )
    return Progress(*columns, console=Console(stderr=True))
