"""Memory that is used again: never while anybody can still see it."""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt

from generator.training.crops import KEPT, Recycled

SHAPE = (4, 3, 32, 32)


def place(array: npt.NDArray[np.float32]) -> int:
    return int(array.__array_interface__["data"][0])


def test_memory_of_which_nothing_is_left_is_used_again() -> None:
    recycled = Recycled()
    first = recycled.array(SHAPE)
    assert first.shape == SHAPE
    assert first.dtype == np.float32
    assert first.flags.c_contiguous
    assert first.flags.writeable
    at = place(first)
    del first
    assert place(recycled.array(SHAPE)) == at


def test_what_is_still_seen_is_left_alone() -> None:
    recycled = Recycled()
    whole = recycled.array(SHAPE)
    whole[...] = 7
    views = [whole[1:, 0], whole.reshape(-1)[::5], whole[2].T]
    buffer = memoryview(whole[3])
    at = place(whole)
    del whole
    for _ in range(2 * KEPT):
        other = recycled.array(SHAPE)
        assert place(other) != at
        other[...] = 1
    assert all((view == 7).all() for view in views)
    assert np.asarray(buffer).min() == 7


def test_sizes_do_not_mix() -> None:
    recycled = Recycled()
    for shape in ((1, 3, 8, 8), (7, 3, 32, 32), SHAPE):
        made = recycled.array(shape)
        made[...] = 3
        assert made.shape == shape


def test_threads_never_share_memory() -> None:
    recycled = Recycled()
    wrong: list[int] = []

    def work(number: int) -> None:
        for _ in range(200):
            mine = recycled.array(SHAPE)
            mine[...] = number
            if not (mine == number).all():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
