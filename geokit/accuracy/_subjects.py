"""Default subjects of a run: the samples, or small generated shapes of the same kinds."""

from __future__ import annotations

from pathlib import Path

from geokit.accuracy.trials.model import Subject
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag
from geokit.errors import GeokitError

__all__ = ["default_subjects", "unique_names"]

SAMPLES = Path(__file__).resolve().parents[2] / "data" / "samples"
# Sharp, smooth and open meshes, closed ones first. A quick run takes the first of each kind.
MESHES = ("bracket.obj", "torus.ply", "shell.stl")
CLOUDS = ("cloud.ply",)
# File and grid.
VOLUMES = (("torus.vdb", "torus"), ("smoke.vdb", "density"))
# Corners around and across the generated torus, its radii, and the number of voxels of its level set.
SEGMENTS = (96, 48)
RADII = (1.0, 0.4)
VOXEL_SIZE = 0.04
HALF_WIDTH = 3.0
CLOUD_COUNT = 20_000


@needs(lambda *_, **__: 8 << 20, fatal=True)  # of modules too: the compiler names a syntax error where it has none
def default_subjects(*, quick: bool = False) -> list[Subject]:
    """The samples of the source tree, or generated shapes if the samples are missing, as in an installed wheel.

    Samples that need a part of geokit that is not installed are replaced in the same way.

    Args:
        quick: Return one mesh, one volume and one cloud.
    Returns:
        Subjects of each kind.
    """
    require_flag(quick, "quick")
    meshes = _loaded_meshes() or [_torus_mesh()]
    volumes = _loaded_volumes() or [_torus_volume()]
    clouds = _loaded_clouds() or [_torus_cloud()]
    return [*meshes[:1], *volumes[:1], *clouds[:1]] if quick else [*meshes, *volumes, *clouds]


def unique_names(subjects: list[Subject]) -> list[Subject]:
    """The subjects, with a number appended to every name that occurred before."""
    taken: set[str] = set()
    found: list[Subject] = []
    for subject in subjects:
        name, number = subject.name, 1
        while name in taken:
            number += 1
            name = f"{subject.name} ({number})"
        taken.add(name)
        found.append(subject._replace(name=name))
    return found


def _loaded_meshes() -> list[Subject]:
    from geokit.mesh import load

    return [Subject(name, mesh=load(SAMPLES / name)) for name in MESHES if (SAMPLES / name).is_file()]


def _loaded_clouds() -> list[Subject]:
    from geokit.points import load

    return [Subject(name, points=load(SAMPLES / name).points) for name in CLOUDS if (SAMPLES / name).is_file()]


def _loaded_volumes() -> list[Subject]:
    from geokit.volume import load

    found: list[Subject] = []
    for name, grid in VOLUMES:
        if not (SAMPLES / name).is_file():
            continue
        try:
            found.append(Subject(name, volume=load(SAMPLES / name, grid=grid)))
        except GeokitError:  # without the OpenVDB extension
            return []
    return found


def _torus_mesh() -> Subject:
    from geokit.accuracy.stability.shapes import torus

    return Subject("torus", mesh=torus(*SEGMENTS, *RADII))


def _torus_volume() -> Subject:
    from geokit.volume import from_mesh

    mesh = _torus_mesh().mesh
    assert mesh is not None
    return Subject("torus volume", volume=from_mesh(mesh, VOXEL_SIZE, half_width=HALF_WIDTH, device="cpu"))


def _torus_cloud() -> Subject:
    from geokit.accuracy.charts.points import torus_cloud

    return Subject("torus cloud", points=torus_cloud(CLOUD_COUNT, noise=0.0)[0])
