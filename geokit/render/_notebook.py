"""Meshes, clouds and volumes in notebooks: their line and a small still picture."""

from __future__ import annotations

import base64
import html
import tempfile
from pathlib import Path
from typing import Any

# Pixels: a picture of some 20 kB, drawn in a fraction of a second.
SIZE = (320, 240)
# Faces, points and active voxels beyond which drawing would hold up the notebook.
MOST = 2_000_000


def notebook_html(thing: Any) -> str:
    """HTML of a mesh, a Surface, a cloud or a volume; without the picture where it cannot be drawn, or is too large.

    A mesh or a volume that is on a GPU stays there and has no picture.
    """
    line = f"<pre>{html.escape(repr(thing))}</pre>"
    scene = _scene(thing)
    if scene is None:
        return line
    from geokit.render._scene import figure

    try:
        with tempfile.TemporaryDirectory() as folder:
            picture = figure(Path(folder) / "picture.png", size=SIZE, transparent=True, **scene).read_bytes()
    except Exception:  # whatever it is, a notebook has asked for no picture
        return line
    data = base64.b64encode(picture).decode("ascii")
    return f'{line}<img alt="" width="{SIZE[0]}" height="{SIZE[1]}" src="data:image/png;base64,{data}">'


def _scene(thing: Any) -> dict[str, Any] | None:
    """What is drawn; None for nothing."""
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.surface import Surface
    from geokit.points._io import PointCloud
    from geokit.volume.model.sparse_volume import SparseVolume

    thing = thing.mesh if isinstance(thing, Surface) else thing
    if isinstance(thing, TriangleMesh):
        return {"mesh": thing} if thing._on_device is None and 0 < thing.face_count <= MOST else None
    if isinstance(thing, PointCloud):
        return {"points": thing} if 0 < len(thing) <= MOST else None
    if isinstance(thing, SparseVolume) and "nanovdb" in thing.__dict__:
        return {"volume": thing} if 0 < (thing.info.active_voxel_count or 0) <= MOST else None
    return None
