"""What a trial has in common with the last one is not looked at again, and what is found stays the same."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.simplification import proof as module
from geokit.mesh.simplification.collapse import collapsed
from geokit.mesh.simplification.proof import Proof
from geokit.mesh.surfaces.surface import Surface
from tests.mesh.simplification.test_simplify import rough


@pytest.mark.parametrize("seed", range(3))
def test_each_trial_is_judged_as_by_a_proof_of_its_own(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, limit = rough(40, seed), 0.004
    original = Surface(mesh, device="cpu")
    asked: list[int] = []
    far_faces = module.far_faces

    def counted(part: TriangleMesh, *rest: object) -> np.ndarray:
        asked.append(part.face_count)
        return far_faces(part, *rest)

    monkeypatch.setattr(module, "far_faces", counted)
    limits = np.full(mesh.face_count, 0.95 * limit)
    kept = Proof(original, limit, True)
    for _ in range(4):
        found, source = collapsed(mesh, limits, 0)
        surface = Surface(found, device="cpu")
        alone = Proof(original, limit, True).wrong(surface, source)
        all_asked = sum(asked)
        asked.clear()
        wrong = kept.wrong(surface, source)
        np.testing.assert_array_equal(wrong, alone)
        assert sum(asked) <= all_asked
        last, asked[:] = sum(asked), []
        assert wrong.any()
        # As simplify does, but here and there alone, so that most of the trial stays.
        limits[np.flatnonzero(wrong)[: 1 + wrong.sum() // 8]] *= 0.7
    assert last < all_asked
    # Nothing changes, so nothing but what is wrong is looked at.
    asked.clear()
    np.testing.assert_array_equal(kept.wrong(surface, source), wrong)
    assert sum(asked) < all_asked / 2
