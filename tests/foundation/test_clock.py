"""Dates of a session advance, even if the machine's clock is set."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from foundation.clock import MIN_STEP_S, Clock, SteadyClock, SystemClock, elapsed_s

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


class SetClock:
    """Clock of a machine that is set by the test; its seconds pass only in the test."""

    def __init__(self) -> None:
        self.date = NOON
        self.seconds = 100.0

    def now(self) -> datetime:
        return self.date

    def monotonic(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds
        self.date += timedelta(seconds=seconds)


def steady(machine: SetClock, not_before: datetime | None = None) -> SteadyClock:
    return SteadyClock(machine, not_before, machine.monotonic)


def test_setting_the_clock_does_not_change_session_time() -> None:
    machine = SetClock()
    clock: Clock = steady(machine)
    clock.sleep(5)
    assert clock.now() == NOON + timedelta(seconds=5)
    for jump in (timedelta(hours=-1), timedelta(days=150)):
        earlier = clock.now()
        machine.date += jump
        clock.sleep(2)
        assert clock.now() - earlier == timedelta(seconds=2)
    assert clock.monotonic() == machine.seconds


def test_reports_a_clock_step_once() -> None:
    machine = SetClock()
    clock = steady(machine, NOON + timedelta(hours=2))
    assert clock.step_s() == 0, "the offset at the start is no step"
    machine.date += timedelta(hours=1)
    clock.sleep(5)
    assert clock.step_s() == 3600
    machine.date -= timedelta(seconds=MIN_STEP_S - 1)
    assert clock.step_s() == 0
    machine.date -= timedelta(minutes=2)
    assert clock.step_s() == -120 - (MIN_STEP_S - 1)


def test_starts_at_the_last_frame_if_the_clock_is_behind() -> None:
    last = NOON + timedelta(hours=3)
    clock = steady(SetClock(), last)
    assert clock.behind_s == 3 * 3600
    clock.sleep(1)
    assert clock.now() == last + timedelta(seconds=1)
    ahead = steady(SetClock(), NOON - timedelta(hours=3))
    assert ahead.behind_s == 0
    assert ahead.now() == NOON


def test_elapsed_seconds_never_decrease() -> None:
    clock = SteadyClock(SystemClock())
    moments = [clock.now() for _ in range(100)]
    assert moments == sorted(moments)
    assert moments[0].tzinfo is UTC
    assert elapsed_s() <= elapsed_s()
