"""Which source nodes a picture has, and what a print makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from generator.kernels.dithering import nearest_nodes
from generator.rendering.cell_mixtures import CellMixtures, summarise
from generator.rendering.colorimetric import NODES, node_codes


def test_every_pixel_counts_as_the_node_nearest_to_it() -> None:
    picture = np.random.default_rng(5).integers(0, 256, (9, 11, 3)).astype(np.uint8)
    nodes = [int(np.square(node_codes() - pixel / 255).sum(axis=1).argmin()) for pixel in picture.reshape(-1, 3)]
    np.testing.assert_array_equal(nearest_nodes(picture), np.bincount(nodes, minlength=NODES))


def test_what_is_missed_counts_by_pixels() -> None:
    rng = np.random.default_rng(6)
    wanted = rng.uniform(0.1, 0.9, (NODES, 3)).astype(np.float32)
    seen = (wanted * rng.uniform(0.9, 1.1, wanted.shape)).astype(np.float32)
    picture = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    counts = nearest_nodes(picture)
    summary = summarise(CellMixtures(np.zeros((NODES, 32), np.uint16), seen, wanted), counts.astype(np.float64))
    each = np.repeat(np.arange(NODES), counts)
    cosines = (seen[each] * wanted[each]).sum(axis=1, dtype=np.float64)
    cosines /= np.linalg.norm(seen[each].astype(float), axis=1) * np.linalg.norm(wanted[each].astype(float), axis=1)
    assert summary.distance_deg == pytest.approx(np.degrees(np.arccos(np.minimum(cosines, 1))).mean(), rel=1e-4)
    off = np.abs(seen[each] / wanted[each] - 1).max(axis=1) > 0.02
    assert summary.outside == pytest.approx(off.mean())
    assert 0 < summary.outside < 1
