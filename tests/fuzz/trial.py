"""What geokit makes of one file: load it, hold what was loaded to its promises, ask it one question."""

from __future__ import annotations

import contextlib
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from benchmarks.catalog.mesh_catalog import torus
from geokit.errors import GeokitError
from tests.fuzz.originals import Original, Target
from tests.support.lying_grids import OPERATIONS

__all__ = ["Facts", "facts_of", "outcome", "write"]

Facts = dict[str, Any]

# Questions take longer than reading: only these shares of mutants are asked one.
RARELY = {"mesh": 4, "points": 16, "rays": 16}
QUERIES = np.array([[0.1, 0.2, 0.3], [2.0, 0.0, 0.0], [-5.0, 3.0, 1e6]])


class Unsound(Exception):
    """An answer or a message that breaks a promise."""


def write(folder: Path, kind: str, data: bytes, beside: dict[str, bytes]) -> Path:
    """The files of a mutant in a folder, or a folder of them; returns the path to load."""
    path = folder / f"a{kind}"
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    for name, content in beside.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    if not path.is_dir():
        path.write_bytes(data)
    return path


def outcome(target: Target, path: Path, sound: Facts, seed: int) -> str:
    """How loading a file and a question to its content end.

    Returns:
        "same" or "differs in ..." for what is accepted, compared with the original; "refused by ..." for a named
        error; anything else is a fault: "raw ..." for another exception, "unsound ..." for a broken promise.
    """
    try:
        return _outcome(target, path, sound, seed)
    except Unsound as fault:
        return f"unsound: {fault}"
    except Exception as error:
        return f"raw {type(error).__name__}: {str(error)[:200]}"


def _outcome(target: Target, path: Path, sound: Facts, seed: int) -> str:
    try:
        with _named_warnings(path):
            found = facts_of(target, path)
    except GeokitError as error:
        text = str(error)
        if str(path) not in text or not text.isprintable():
            raise Unsound(f"the message {text!r} does not name the file in one line of printable text") from None
        return f"refused by {type(error).__name__}"
    names = {name for name in {*found, *sound} if not name.endswith(" volume")}
    different = sorted(name for name in names if not _equal(found.get(name), sound.get(name)))
    if seed % RARELY.get(target.content, 1) == 0:
        with contextlib.suppress(GeokitError), _named_warnings():
            _USES[target.content](path, found, seed)
    # Names of data are the file's: what differs is told without them, and without numbers of grids.
    told = sorted({re.sub(r"^data .*", "data", re.sub(r"^\d+ ", "", name)) for name in different})
    return f"differs in {', '.join(told)}" if told else "same"


@contextlib.contextmanager
def _named_warnings(path: Path | None = None) -> Iterator[None]:
    """What geokit leaves out of a file, it says in a warning that names the file; any other is printed, a fault.

    What it says of an operation names no file.
    """
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        yield
    for warning in given:
        if warning.category is not UserWarning:
            print(warning, file=sys.stderr)
        elif (path and str(path) not in str(warning.message)) or not str(warning.message).isprintable():
            raise Unsound(f"the warning {str(warning.message)!r} does not name the file in one line of printable text")


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and repr(a) == repr(b)


def facts_of(target: Target, path: Path) -> Facts:
    """Everything that a file holds, by name.

    Raises:
        GeokitError: The file is refused.
        Unsound: What was loaded is not what geokit promises.
    """
    return _LOADS[target.content](path)


def _require(holds: Any, what: str) -> None:
    if not holds:
        raise Unsound(what)


def _mesh(path: Path) -> Facts:
    mesh = gk.mesh.load(path)
    _require(len(mesh.faces), "a mesh without faces")
    _require(np.isfinite(mesh.vertices).all(), "vertices that are not finite")
    _require(mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices), "indices out of range")
    counts = {"vertex count": len(mesh.vertices), "face count": len(mesh.faces)}
    return {"vertices": mesh.vertices, "faces": mesh.faces, "parts": mesh.parts, **counts, "name": mesh.name}


def _points(path: Path) -> Facts:
    cloud = gk.points.load(path)
    _require(np.isfinite(cloud.points).all(), "points that are not finite")
    _require(all(len(values) == len(cloud) for values in cloud.data.values()), "data of another length")
    arrays = {f"data {name}": values for name, values in cloud.data.items()}
    return {"points": cloud.points, "point count": len(cloud), "names of data": sorted(cloud.data), **arrays}


def _rays(path: Path) -> Facts:
    rays = gk.points.load_rays(path)
    _require(np.isfinite(rays.origins).all() and np.isfinite(rays.directions).all(), "rays that are not finite")
    _require((rays.directions != 0).any(axis=1).all(), "directions of length zero")
    return {"origins": rays.origins, "directions": rays.directions, "ray count": len(rays.origins)}


def _volume(path: Path) -> Facts:
    volumes = gk.volume.load_all(path)
    facts: Facts = {"grids": sorted(volumes)}
    for i, (name, volume) in enumerate(volumes.items()):
        info = volume.info
        facts |= {f"{i} volume": volume, f"{i} name": name, f"{i} transform": info.transform}
        facts |= {f"{i} class": info.grid_class, f"{i} background": repr(info.background)}
        facts |= {f"{i} type": info.grid_type, f"{i} metadata": repr(dict(info.metadata))}
        # The tree: everything behind the headers.
        facts |= {f"{i} tree": volume.nanovdb[736:], f"{i} statistics": volume.nanovdb[560:632]}
    return facts


_LOADS: dict[str, Callable[[Path], Facts]] = {"mesh": _mesh, "points": _points, "rays": _rays, "volume": _volume}


def _ask_mesh(path: Path, facts: Facts, seed: int) -> None:
    mesh = gk.mesh.TriangleMesh(facts["vertices"], facts["faces"])
    if seed % 8 == 0:
        gk.mesh.audit(mesh)
        return
    surface = gk.mesh.Surface(mesh, device="cpu")
    found = surface.closest_point(QUERIES)
    _require((found.triangle_id < len(mesh.faces)).all(), "a triangle that does not exist")
    surface.raycast(QUERIES, -np.eye(3))


def _ask_points(path: Path, facts: Facts, seed: int) -> None:
    if not len(facts["points"]):
        return
    found = gk.points.NeighborGrid(facts["points"], radius=0.5, device="cpu").radius_search(QUERIES)
    _require((found.indices < len(facts["points"])).all(), "a neighbor that does not exist")


def _ask_rays(path: Path, facts: Facts, seed: int) -> None:
    surface = gk.mesh.Surface(torus(12, 8), device="cpu")
    surface.raycast(facts["origins"], facts["directions"])


def _ask_volume(path: Path, facts: Facts, seed: int) -> None:
    operation = [*OPERATIONS.values()][seed % len(OPERATIONS)]
    for name, volume in facts.items():
        if name.endswith(" volume"):
            operation(volume, path.parent)
    if path.suffix == ".nvdb" or seed % 8 == 0:
        with _named_warnings(path):
            gk.volume.inspect(path)


_USES: dict[str, Callable[[Path, Facts, int], None]] = {
    "mesh": _ask_mesh, "points": _ask_points, "rays": _ask_rays, "volume": _ask_volume,
}  # fmt: skip


def sound_facts(target: Target, sources: list[Original], folder: Path) -> dict[str, Facts]:
    """Facts of the originals, by variant; each must load."""
    found = {}
    for original in sources:
        path = write(folder, target.kind, original.data, original.beside)
        found[original.variant] = facts_of(target, path)
        for seed in range(
            len(OPERATIONS) if target.content == "volume" and not found.keys() - {original.variant} else 1
        ):
            try:
                _USES[target.content](path, found[original.variant], seed)
            except GeokitError:
                continue
    return found
