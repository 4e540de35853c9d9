"""User methods in a run: returned values, errors, changed images; and images under several illuminants."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.running import evaluate
from evaluation.methods import GrayEdge
from evaluation.methods.naming import find_method
from evaluation.methods.prepared import GREY
from evaluation.metrics import recovery_error
from evaluation.scene import Scene
from foundation.errors import InputError
from tests.evaluation.made_up import MixedWall, Wall, walls

GRAY_WORLD = GrayEdge("Gray-world", 0, 1, 0, 0)
LIGHTS = np.array([[2.0, 1, 1], [1, 1, 1]])


class FixedValues:
    """User method that returns, or raises, the given values one after another."""

    name = "Stranger"

    def __init__(self, *values: object) -> None:
        self.values = iter(values)

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> Any:
        value = next(self.values)
        if isinstance(value, BaseException):
            raise value
        return value


@pytest.mark.parametrize(
    ("value", "cause"),
    [
        (None, "returned None"),
        ((np.inf, 1, 1), "returned inf 1 1"),
        ((0, 0, 0), "returned 0 0 0"),
        (GREY, "no usable pixel"),
    ],
)
def test_missing_estimate_is_counted_and_grey(value: object, cause: str) -> None:
    scenes = walls(3)
    (result,) = evaluate(scenes, [FixedValues((3, 4, 0), value, [0.1, 0.1, 0.1])])
    assert result.guessed.tolist() == [False, True, False]
    assert result.causes == {1: cause}
    np.testing.assert_allclose(result.estimates, [[0.6, 0.8, 0], [3**-0.5] * 3, [3**-0.5] * 3])
    assert result.errors["recovery"][1] == pytest.approx(float(recovery_error([1, 1, 1], scenes[1].truth)))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.ones((4, 3)), r"shape \(4, 3\), expected \(3,\)"),
        (SystemExit(0), r"SystemExit: 0 \(test_running\.py, line \d+\)"),
        (KeyError("where"), r"KeyError: 'where' \(test_running\.py, line \d+\)"),
        (np.array([1 + 1j, 1, 1]), "returned ndarray of complex128, expected three real numbers"),
        ([True, True, False], "returned list of bool, expected three real numbers"),
        (np.ma.masked_array([1.0, 1, 1], [False, False, True]), "returned MaskedArray, expected three real numbers"),
    ],
)
def test_faulty_method_is_reported_by_name(value: object, message: str) -> None:
    with pytest.raises(InputError, match=rf"^Stranger failed on wall 1\.png: .*{message}.*; correct it, then run"):
        evaluate(walls(3), [FixedValues((1, 1, 1), value, (1, 1, 1))])


def test_reports_line_of_user_file(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "import numpy as np\n\nclass Own:\n    name = 'Own'\n\n"
        "    def estimate(self, image, saturation=None, mask=None):\n        return np.linalg.inv(np.zeros((3, 3)))\n"
    )
    method = find_method(f"{file}:Own")
    with pytest.raises(InputError, match=r"Own failed on wall 0\.png: LinAlgError: .*\(own\.py, line 7\)"):
        evaluate(walls(1), [method])  # pyrefly: ignore[bad-argument-type]


def test_refuses_run_without_methods() -> None:
    with pytest.raises(InputError, match="0 methods on 3 images"):
        evaluate(walls(3), [])


@pytest.mark.parametrize("light", [(0, 0, 0), (np.nan, 1, 1), (np.inf, 1, 1), (1, 1, -1)])
def test_refuses_invalid_ground_truth_before_reading(light: tuple[float, ...]) -> None:
    read: list[str] = []
    with pytest.raises(InputError, match=r"dark\.png.*blue"):
        evaluate([*walls(1, read), Wall("dark.png", np.array(light))], [GRAY_WORLD])
    assert not read


class ChangesImage:
    """User method that overwrites the image it receives."""

    name = "Destroys"

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> npt.NDArray[np.float64]:
        light = image.mean(axis=(0, 1)).astype(np.float64)
        image[:] = 0
        return light


class InMemory(Wall):
    """A wall that returns the same array every time, as thumbnails do."""

    def read(self) -> tuple[npt.NDArray[np.float32], None]:
        return IMAGE, None


IMAGE = (np.random.default_rng(0).random((6, 6, 3)) + 0.1).astype(np.float32)


def test_method_cannot_change_images_of_others() -> None:
    scenes = [InMemory("one", np.ones(3)), InMemory("two", np.ones(3))]
    alone = evaluate(scenes, [GRAY_WORLD])[0].estimates
    results = evaluate(scenes, [ChangesImage(), GRAY_WORLD])
    np.testing.assert_array_equal(results[1].estimates, alone)
    assert results[0].errors["recovery"][1] == results[0].errors["recovery"][0]


class SingleThreaded:
    """User method that fails if two threads call it at the same time."""

    name = "Counts"

    def __init__(self) -> None:
        self.busy = Lock()

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> npt.NDArray[np.float64]:
        assert self.busy.acquire(blocking=False), "two threads at once"
        sum(range(20_000))
        self.busy.release()
        return np.asarray(image.mean(axis=(0, 1)), dtype=np.float64)


def test_user_method_runs_in_one_thread_at_a_time() -> None:
    scenes = walls(40)
    (single,) = evaluate(scenes, [SingleThreaded()], workers=1)
    (threaded,) = evaluate(scenes, [SingleThreaded()], workers=4)
    np.testing.assert_array_equal(single.estimates, threaded.estimates)


class HalfRight:
    """User method with a map: correct on the left part, grey elsewhere; its single estimate is white."""

    name = "Half right"

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> npt.NDArray[np.float64]:
        return np.ones(3)

    def estimate_map(self, image: Any, saturation: float | None = None, mask: Any = None) -> npt.NDArray[np.float32]:
        lights = np.full(image.shape, 1 / 3, np.float32)
        lights[:, :4] = (0.5, 0.25, 0.25)
        return lights


def test_errors_by_pixel_and_region() -> None:
    scenes: list[Scene] = [*walls(1), MixedWall("mixed", LIGHTS)]
    global_result, local = evaluate(scenes, [FixedValues((1, 1, 1), (1, 1, 1)), HalfRight()], workers=1)
    angle = float(recovery_error(LIGHTS[0], LIGHTS[1]))
    ((index, error),) = (global_result.maps or {}).items()
    assert index == 1
    assert error.recovery == pytest.approx(angle / 4, abs=1e-4)
    assert [region.recovery for region in error.regions] == pytest.approx([angle, 0], abs=1e-4)
    assert [region.share for region in error.regions] == pytest.approx([0.25, 0.75])
    error = (local.maps or {})[1]
    assert (error.recovery, error.rgb) == pytest.approx((0, 0), abs=1e-4)
    # The single estimates of both are compared with the mean illuminant.
    assert local.errors["recovery"][1] == global_result.errors["recovery"][1] > 1


def _two_pixels(lights: Any) -> Any:
    lights[0, 0] = np.nan
    lights[0, 1] = 0
    return lights


def _half(lights: Any) -> Any:
    return lights[:6]


def _integers(lights: Any) -> Any:
    return (lights * 100).astype(np.uint8)


def altered(monkeypatch: pytest.MonkeyPatch, change: Callable[[Any], Any]) -> HalfRight:
    """Return a method whose map is changed before it is returned."""
    right = HalfRight().estimate_map

    def wrong(_: object, image: Any, saturation: float | None = None, mask: Any = None) -> Any:
        return change(right(image, saturation, mask))

    monkeypatch.setattr(HalfRight, "estimate_map", wrong)
    return HalfRight()


@pytest.mark.parametrize(
    ("change", "message"),
    [(_half, r"float32 of shape \(6, 16, 3\), expected floats \(12, 16, 3\)"), (_integers, "uint8 of shape")],
)
def test_refuses_invalid_map(monkeypatch: pytest.MonkeyPatch, change: Callable[[Any], Any], message: str) -> None:
    method = altered(monkeypatch, change)
    with pytest.raises(InputError, match=f"failed on mixed: .*{message}"):
        evaluate([MixedWall("mixed", LIGHTS)], [method])


def test_pixels_without_estimate_are_counted_and_grey(monkeypatch: pytest.MonkeyPatch) -> None:
    (result,) = evaluate([MixedWall("mixed", LIGHTS)], [altered(monkeypatch, _two_pixels)])
    assert result.causes == {0: "no estimate in 2 of 192 pixels of its map"}
    assert not result.guessed.any()
    # Two of 192 pixels under the red illuminant are grey.
    assert (result.maps or {})[0].recovery == pytest.approx(float(recovery_error(*LIGHTS)) * 2 / 192, rel=1e-3)
