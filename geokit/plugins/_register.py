"""Adding geokit to the libraries that know no entry points for it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from geokit.core.require import require_choice
from geokit.errors import MissingDependencyError


def register(*libraries: str) -> dict[str, tuple[str, ...]]:
    """Make other libraries read and write volumes through geokit, for the rest of this process.

    - trimesh: ``trimesh.load_mesh("ball.vdb")`` for an isosurface, and
      ``trimesh.load("smoke.vdb", file_type="vdb_voxels")`` for a scene with a VoxelGrid;
    - meshio: ``meshio.read("smoke.vdb")`` and ``mesh.write("ball.vdb", voxel_size=0.1)``;
    - pyvista: ``polydata.geokit`` and ``image.geokit``. PyVista 0.48 and later find these and files by themselves.

    Importing geokit alone changes nothing in other libraries. What another package has registered stays as it is, and a
    second call changes nothing.

    Args:
        libraries: "trimesh", "meshio", "pyvista"; none given for all that are installed. They are imported.
    Returns:
        What leads to geokit now, by library: file types, extensions, attributes.
    Raises:
        InputError: A name is none of these.
        MissingDependencyError: A library that was named is not installed.
    Example:
        >>> geokit.register("meshio")
        {'meshio': ('.vdb', '.nvdb')}
    """
    for library in libraries:
        require_choice(library, "libraries", tuple(_REGISTER))
    found = {}
    for library in libraries or _REGISTER:
        try:
            importlib.import_module(library)
        except ImportError:
            if libraries:
                raise MissingDependencyError(
                    f"register needs the package {library}; install it with: pip install {library}"
                ) from None
            continue
        found[library] = _REGISTER[library]()
    return found


def _trimesh() -> tuple[str, ...]:
    from trimesh.exchange.load import mesh_loaders, voxel_loaders

    from geokit.plugins.trimesh_files import MESH_TYPES, VOXEL_TYPES, load_mesh, load_voxels

    tables: list[tuple[Any, str, Any]] = [(mesh_loaders, kind, load_mesh) for kind in MESH_TYPES]
    tables += [(voxel_loaders, kind, load_voxels) for kind in VOXEL_TYPES]
    return tuple(kind for table, kind, loader in tables if table.setdefault(kind, loader) is loader)


def _meshio() -> tuple[str, ...]:
    import meshio

    from geokit.plugins.meshio_files import FORMATS, read, write

    for name, kinds in FORMATS.items():
        # meshio lists a format that is registered twice two times.
        if not any(meshio.extension_to_filetypes.get(kind) for kind in kinds):
            meshio.register_format(name, kinds, read, {name: write})
    return tuple(
        kind for name, kinds in FORMATS.items() for kind in kinds if meshio.extension_to_filetypes[kind] == [name]
    )


def _pyvista() -> tuple[str, ...]:
    from geokit.plugins.pyvista_accessors import ACCESSORS, attach

    attach()
    return tuple(f"{name}.geokit" for name in ACCESSORS)


_REGISTER: dict[str, Callable[[], tuple[str, ...]]] = {"trimesh": _trimesh, "meshio": _meshio, "pyvista": _pyvista}
