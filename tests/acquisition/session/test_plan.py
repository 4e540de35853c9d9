"""The plan of a session: which frames, in which order."""

from __future__ import annotations

from acquisition.lights.illuminations import Illumination
from acquisition.session.plan import SessionStep, plan_steps
from drivers.presenter import BLACK, WHITE, Colour

LIGHTS = tuple(Illumination(number, "uniform", None, Colour(255, number, 0)) for number in range(5))


def test_the_plan_puts_white_and_dark_before_between_and_after() -> None:
    steps = plan_steps(LIGHTS, 2)
    kinds = "".join(step.kind[0] for step in steps)
    assert kinds == "wdllwdllwdlwd"
    assert [step.number for step in steps] == list(range(len(steps)))
    assert {step.colour for step in steps if step.kind == "white"} == {WHITE}
    assert {step.colour for step in steps if step.kind == "dark"} == {BLACK}
    assert [step.illumination for step in steps if step.kind == "light"] == [0, 1, 2, 3, 4]


def test_a_step_names_its_file_so_that_files_sort_in_taking_order() -> None:
    steps = plan_steps(LIGHTS, 2)
    stems = [step.stem for step in steps]
    assert stems[:3] == ["0000_white", "0001_dark", "0002_light_000"]
    assert stems == sorted(stems)
    assert SessionStep(7, "light", 5, WHITE).stem == "0007_light_005"
