"""What notebooks show of meshes, clouds and volumes."""

from __future__ import annotations

import base64
import io
import re
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.errors import MissingDependencyError

BALL = mesh_catalog.icosphere(2)


def picture(text: str) -> np.ndarray:
    from matplotlib.image import imread

    found = re.search(r'src="data:image/png;base64,([^"]+)"', text)
    assert found
    return imread(io.BytesIO(base64.b64decode(found[1])))


@pytest.mark.parametrize(
    "make",
    [
        lambda: BALL,
        lambda: gk.mesh.Surface(BALL, device="cpu"),
        lambda: gk.points.PointCloud(BALL.vertices),
        lambda: gk.volume.from_mesh(BALL, 0.2, device="cpu"),
        lambda: gk.volume.from_dense(np.random.default_rng(1).random((8, 8, 8)), grid_class="fog volume"),
    ],
    ids=["mesh", "surface", "cloud", "level set", "fog"],
)
def test_a_small_picture_and_the_line(make: Any) -> None:
    thing = make()
    text = thing._repr_html_()
    assert text.startswith("<pre>" + repr(thing)[:12].replace("<", "&lt;"))
    drawn = picture(text)
    assert drawn.shape[:2] == (240, 320)
    # On nothing stands something.
    assert 0.005 < (drawn[..., 3] > 0.5).mean() < 0.9
    assert len(text) < 200_000


def test_the_line_alone_where_nothing_can_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    empty = gk.mesh.TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), int), name="<b>")
    assert empty._repr_html_() == "<pre>TriangleMesh(&#x27;&lt;b&gt;&#x27;, 3 vertices, 0 faces)</pre>"
    labels = gk.volume.from_dense(np.zeros((2, 2, 2)))
    assert "<img" not in labels._repr_html_()

    def fails() -> Any:
        raise MissingDependencyError("no OpenGL here")

    monkeypatch.setattr("geokit.render._scene.pyvista", fails)
    assert "<img" not in BALL._repr_html_()


def test_large_things_are_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("geokit.render._notebook.MOST", 10)
    for thing in (BALL, gk.points.PointCloud(BALL.vertices), gk.volume.from_mesh(BALL, 0.2, device="cpu")):
        assert "<img" not in thing._repr_html_()
