"""Charts and illuminants shared with the tests of the experiment."""

from tests.calibration.lab import rendered_once
from tests.experiment.conftest import a0, a7, plan

__all__ = ["a0", "a7", "plan", "rendered_once"]
