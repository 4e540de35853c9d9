"""How far `generate` has come, on a terminal and in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Final

from foundation.console import shows_progress
from foundation.secret_texts import printable

if TYPE_CHECKING:
    from rich.progress import Progress

    from generator.dataset.shards import Callbacks


# Work that is done within so many seconds gets no bar but its last line: what draws bars takes a tenth to load.
SOON_S: Final = 0.5


@contextmanager
def shown_progress(images: int) -> Generator[Callbacks]:
    """Show how many images are made, how fast, and the time left while the block runs.

    On a terminal that is a bar; elsewhere, and where the work is done at once, one line at the end.
    """
    from generator.dataset.shards import SILENT, Callbacks

    if not shows_progress():
        yield SILENT
        return
    with ExitStack() as shown:
        count = _Images(images, shown)
        try:
            yield Callbacks(on_done=count.leave_out, on_image=count.advance, on_skip=count.skip, on_wait=count.warn)
        finally:
            count.end()


class _Images:
    """How many images are made."""

    def __init__(self, total: int, shown: ExitStack) -> None:
        self._total = total
        self._shown = shown
        self._made = self._found = self._told = 0
        self._began = time.monotonic()
        self._bar: Progress | None = None

    def leave_out(self, images: int) -> None:
        """Count more images that are found finished; less than 0 takes some back."""
        self._total -= images
        self._found += images

    def advance(self) -> None:
        """Show that one more image is made, and the mean rate: a cluster reports the images of a shard at once."""
        self._made += 1
        if not self._told:
            self._tell_found()
        if self._bar is None and sys.stderr.isatty() and time.monotonic() - self._began > SOON_S:
            self._bar = self._shown.enter_context(_bar())
            self._bar.add_task("images", total=self._total, rate="", left="")
        self._update()

    def skip(self, name: str, reason: str, images: int) -> None:
        """Show that a picture cannot be read, and why."""
        self._total -= images
        self.warn(f"left out {name}: {reason}")
        self._update()

    def warn(self, sentence: str) -> None:
        """Show what the user should know meanwhile."""
        self._print(sentence, style="yellow")

    def end(self) -> None:
        """Show what was found of shards that were taken up later, and what was made, where no bar does."""
        self._tell_found()
        if self._bar is None:
            print(f"images {self._made}/{self._total} {self._rate():.1f}/s", file=sys.stderr)

    def _tell_found(self) -> None:
        """Show how many images were found finished in all; shards that were begun are found one after another."""
        if self._found > self._told:
            self._print(f"{self._found} images were found finished" + (" in all" if self._told else ""))
            self._told = self._found

    def _rate(self) -> float:
        return self._made / max(time.monotonic() - self._began, 0.1)

    def _update(self) -> None:
        if self._bar is None or not self._made:
            return
        rate = self._rate()
        left = timedelta(seconds=round(max(self._total - self._made, 0) / rate))
        task = self._bar.task_ids[0]
        self._bar.update(task, completed=self._made, total=self._total, rate=f"{rate:.1f}/s", left=f"{left} left")

    def _print(self, sentence: str, style: str | None = None) -> None:
        """Print a line above the bar; names in it are others', and are not obeyed."""
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
