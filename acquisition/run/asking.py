"""Ask every device, also when another one failed, so that a lab is told all its faults at once.

Whoever mends a cable wants to know of the other one too: each walk to the lab costs more than all questions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from foundation.errors import ConfigurationError, CropError, DeviceError

Questions = Mapping[str, Callable[[], object]]
"""What is asked, by the name of the device; each raises what its device says against it."""


def ask_all(questions: Questions, further: Questions | None = None) -> None:
    """Ask each question, and raise what went wrong with all of them together."""
    faults = _faults_of(questions)
    if not faults:
        return
    faults |= _faults_of({name: question for name, question in (further or {}).items() if name not in faults})
    if len(faults) == 1:
        raise next(iter(faults.values()))
    of_settings = all(isinstance(fault, ConfigurationError) for fault in faults.values())
    kind = ConfigurationError if of_settings else DeviceError
    listed = "".join(f"\n  {name}: {fault}" for name, fault in faults.items())
    raise kind(f"{len(faults)} of {len(questions)} devices cannot be used:{listed}") from next(iter(faults.values()))


def _faults_of(questions: Questions) -> dict[str, CropError]:
    faults: dict[str, CropError] = {}
    for name, question in questions.items():
        try:
            question()
        except (DeviceError, ConfigurationError) as fault:
            faults[name] = fault
    return faults
