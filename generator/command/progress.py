"""What the command shows on stderr while images are made."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING

from generator.dataset.production.workers import Callbacks

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


@contextmanager
def shown_progress(images: int) -> Generator[Callbacks]:
    """Show how many images are made, how fast, and the time left while the block runs.

    Parameters
    ----------
    images
        How many are to be made.

    Yields
    ------
    Callbacks
        To be called while they are made.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        TextColumn("[progress.description]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = _Bar(progress, progress.add_task("images", total=images, rate="", left=""))
        yield Callbacks(on_done=bar.leave_out, on_image=bar.advance, on_skip=bar.skip, on_wait=bar.warn)


@dataclass(frozen=True)
class _Bar:
    """A progress bar of images, with lines above it."""

    progress: Progress
    task: TaskID

    @property
    def total(self) -> float:
        """Images that are to be made."""
        return self.progress.tasks[0].total or 0

    def leave_out(self, images: int) -> None:
        """Show that images were made by an earlier run."""
        if images:
            self.progress.update(self.task, total=self.total - images)
            self.progress.console.print(f"{images} images were made by an earlier run", highlight=False)

    def advance(self) -> None:
        """Show that one more image is made, and the mean rate: a cluster reports the images of a shard at once."""
        shown = self.progress.tasks[0]
        made, took = shown.completed + 1, max(shown.elapsed or 0, 0.1)
        left = timedelta(seconds=round(max(self.total - made, 0) * took / made))
        self.progress.update(self.task, advance=1, rate=f"{made / took:.1f}/s", left=f"{left} left")

    def skip(self, name: str, reason: str, images: int) -> None:
        """Show that a picture cannot be read, and why."""
        self.progress.update(self.task, total=self.total - images)
        self.warn(f"left out {name}: {reason}")

    def warn(self, sentence: str) -> None:
        """Show what the user should know meanwhile."""
        self.progress.console.print(sentence, style="yellow", markup=False, highlight=False)
