"""What the suite uses of pyapriltags 3.4 (untyped)."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

class Detection(NamedTuple):
    tag_family: bytes
    tag_id: int
    hamming: int
    decision_margin: float
    homography: npt.NDArray[np.float64]
    center: npt.NDArray[np.float64]
    corners: npt.NDArray[np.float64]
    pose_R: npt.NDArray[np.float64] | None
    pose_t: npt.NDArray[np.float64] | None
    pose_err: float | None
    tag_size: float | None

class Detector:
    def __init__(
        self,
        families: str = ...,
        nthreads: int = ...,
        quad_decimate: float = ...,
        quad_sigma: float = ...,
        refine_edges: int = ...,
        decode_sharpening: float = ...,
        debug: int = ...,
        searchpath: list[str] = ...,
    ) -> None: ...
    def detect(self, img: npt.NDArray[np.uint8]) -> list[Detection]: ...
