"""Bodies in .3mf: an archive of XML models whose objects refer to each other, also across files.

Source:
    3MF Consortium, 3MF Core Specification 1.3; Production Extension 1.1, for parts in files of their own.
"""

from __future__ import annotations

import array
import posixpath
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import damaged
from geokit.errors import FileFormatError
from geokit.formats.file_content.body import Body
from geokit.formats.text_files.decimal import written_rows

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Meters in the units that a file can name.
_UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
# Resources that say how triangles look.
_COLORS = ("basematerials", "colorgroup", "texture2dgroup", "compositematerials")
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/"
_MODEL_RELATION = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_USUAL = "3D/3dmodel.model"
# Required extensions that leave the triangles what they are, by parts of their names.
_HARMLESS = ("/production/", "/material/", "/slice/", "/trianglesets/", "/securecontent/", "prusa3d.com", "bambulab")
# Objects that are no part of what is made: supports, and what cuts or marks other bodies.
_ASIDE = ("support", "solidsupport", "other")
# Components of components: a small file can place as many bodies as it likes.
_MOST_BODIES = 1 << 16


def content_bytes(path: Path) -> int:
    """Size of the decompressed parts.

    Raises:
        FileFormatError: The archive is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return sum(part.file_size for part in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise FileFormatError(f"{path}: is not an archive ({error}); the file is damaged, export it again") from None


def read_mesh(path: Path) -> list[Body]:
    """Read what the build of the file names: each mesh at each of its places. Ids belong to the file they stand in.

    Supports and objects of type "other" (cutters and modifiers of slicers) are left out, and so are colors and
    materials, with a note.
    """
    archive = _Archive(path)
    start = archive.start()
    root = archive.model(start)
    found = _Placed(archive)
    if sum(found.objects_at(start, place, ()) for place in root.items) > _MOST_BODIES:
        raise FileFormatError(f"{path}: places more than {_MOST_BODIES:,} bodies; export fewer at a time")
    for place in root.items:
        found.add(start, place, np.eye(4), ())
    if not root.items:
        raise FileFormatError(f"{path}: its build names no object; a mesh needs faces, export the model itself")
    if not found.bodies:
        raise FileFormatError(f"{path}: holds no geometry with faces; a mesh needs faces, export the surface itself")
    notes = []
    if found.aside:
        notes.append(f"{found.aside} supports, cutters or modifiers are left out")
    if any(model.colored for model in archive.models.values()):
        notes.append("its colors and materials are left out")
    others = {model.unit for model in archive.models.values() if model.unit} - {root.unit or "millimeter"}
    if others:
        notes.append(f"parts in {', '.join(sorted(others))} are taken as the file's {root.unit or 'millimeter'}")
    first = found.bodies[0]
    found.bodies[0] = first._replace(meters_per_unit=_UNITS[root.unit or "millimeter"], up_axis="z", notes=tuple(notes))
    return found.bodies


class _Place(NamedTuple):
    """Where an object stands: its file ("" for the same), its id, and a matrix for column vectors."""

    file: str
    object: str
    matrix: NDArray[np.float64]


@dataclass
class _Object:
    name: str
    kind: str
    vertices: array.array[float] = field(default_factory=lambda: array.array("d"))
    triangles: array.array[int] = field(default_factory=lambda: array.array("q"))
    components: list[_Place] = field(default_factory=list)


@dataclass
class _Model:
    unit: str = ""
    colored: bool = False
    objects: dict[str, _Object] = field(default_factory=dict)
    items: list[_Place] = field(default_factory=list)


class _Archive:
    """The parts of a file; models are read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.models: dict[str, _Model] = {}
        with zipfile.ZipFile(path) as archive:
            self._parts = {_key(name): name for name in archive.namelist()}

    def read(self, name: str) -> bytes:
        try:
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(self._parts[_key(name)])
        except KeyError:
            raise damaged(self.path, f"refers to {name[:200]!r}, which is not in it") from None
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
            raise damaged(self.path, f"{name[:200]!r} cannot be unpacked ({error})") from None

    def start(self) -> str:
        """Name of the model with the build."""
        if _key("_rels/.rels") in self._parts:
            targets: list[str] = []

            def begin(name: str, attributes: dict[str, str]) -> None:
                if name.endswith("Relationship") and attributes.get("Type") == _MODEL_RELATION:
                    targets.append(attributes.get("Target", ""))

            _parse(self.read("_rels/.rels"), f"{self.path}: _rels/.rels", begin, {})
            if targets:
                return targets[0].lstrip("/")
        if _key(_USUAL) not in self._parts:
            raise FileFormatError(f"{self.path}: holds no {_USUAL}, so it is no 3MF file; export it again")
        return _USUAL

    def model(self, name: str) -> _Model:
        """The model in a part."""
        key = _key(name)
        if key not in self.models:
            self.models[key] = _read_model(self.read(name), f"{self.path}: {name}")
        return self.models[key]


class _Placed:
    """Bodies, as they are found."""

    def __init__(self, archive: _Archive) -> None:
        self.archive = archive
        self.bodies: list[Body] = []
        self.aside = 0
        self._counts: dict[tuple[str, str], int] = {}

    def objects_at(self, file: str, place: _Place, above: tuple[tuple[str, str], ...]) -> int:
        """Number of objects that stand at a place, without placing them; what is damaged is left to :meth:`add`."""
        file, here, found = self._found(file, place)
        if found is None or found.kind in _ASIDE or here in above:
            return 0
        if here not in self._counts:
            parts = (self.objects_at(file, component, (*above, here)) for component in found.components)
            self._counts[here] = 1 + sum(parts)
        return self._counts[here]

    def _found(self, file: str, place: _Place) -> tuple[str, tuple[str, str], _Object | None]:
        """The file and the object that a place names, as seen from a file, and both as a key."""
        file = posixpath.normpath(place.file).lstrip("/") if place.file else file
        return file, (_key(file), place.object), self.archive.model(file).objects.get(place.object)

    def add(self, file: str, place: _Place, matrix: NDArray[np.float64], above: tuple[tuple[str, str], ...]) -> None:
        """Add what stands at a place, as seen from a file, below the objects ``above``."""
        path = self.archive.path
        file, here, found = self._found(file, place)
        if found is None:
            raise damaged(path, f"{file} has no object {place.object[:40]!r}")
        if here in above:
            raise damaged(path, f"object {place.object[:40]!r} in {file} is part of itself")
        if found.kind in _ASIDE:
            self.aside += 1
            return
        matrix = matrix @ place.matrix
        if found.triangles:
            self.bodies.append(_body(found, matrix))
        for component in found.components:
            self.add(file, component, matrix, (*above, here))


def _body(found: _Object, matrix: NDArray[np.float64]) -> Body:
    triangles = np.frombuffer(found.triangles, np.int64)
    return Body(
        np.frombuffer(found.vertices, np.float64).reshape(-1, 3),
        np.full(len(triangles) // 3, 3),
        triangles,
        name=found.name,
        transform=None if np.array_equal(matrix, np.eye(4)) else matrix,
    )


def _read_model(data: bytes, where: str) -> _Model:
    """Parse a model part. Names of elements are those of any version of the core's namespace."""
    model = _Model()
    current: list[_Object] = []
    spaces: dict[str, str] = {}
    required: list[str] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        space, _, local = name.rpartition(" ")
        model.colored |= local in _COLORS
        if space and not space.startswith(_CORE):
            return
        if local == "vertex":
            current[-1].vertices.extend((float(attributes["x"]), float(attributes["y"]), float(attributes["z"])))
        elif local == "triangle":
            current[-1].triangles.extend((int(attributes["v1"]), int(attributes["v2"]), int(attributes["v3"])))
        elif local == "object":
            made = _Object(attributes.get("name") or attributes["id"], attributes.get("type", "model"))
            if _extended(attributes, "meshresolution") == "lowres":
                raise FileFormatError(
                    f"{where}: object {attributes['id']!r} holds slices in place of its mesh, which are not read; "
                    "export it as a mesh"
                )
            model.objects[attributes["id"]] = made
            current.append(made)
        elif local == "component":
            current[-1].components.append(_place(attributes))
        elif local == "item":
            model.items.append(_place(attributes))
        elif local == "model":
            model.unit = attributes.get("unit", "")
            if model.unit and model.unit not in _UNITS:
                raise FileFormatError(
                    f"{where}: its unit is {model.unit[:40]!r}, none of {', '.join(_UNITS)}; export it again"
                )
            required.extend(attributes.get("requiredextensions", "").split())
            for prefix in required:
                named = spaces.get(prefix, prefix)
                if not any(part in named.lower() for part in _HARMLESS):
                    raise FileFormatError(
                        f"{where}: requires the 3MF extension {named[:120]!r}, which is not read; export it as a mesh"
                    )

    _parse(data, where, begin, spaces)
    return model


def _place(attributes: dict[str, str]) -> _Place:
    matrix = np.eye(4)
    if "transform" in attributes:
        # Rows of the file are columns here.
        numbers = [float(number) for number in attributes["transform"].split()]
        matrix[:3] = np.reshape(numbers, (4, 3)).T
        if not np.isfinite(matrix).all():
            raise ValueError("a transform that is not finite")
    return _Place(_extended(attributes, "path"), attributes["objectid"], matrix)


def _extended(attributes: dict[str, str], name: str) -> str:
    """Value of an attribute of an extension, whatever its version; "" if there is none."""
    return next((value for key, value in attributes.items() if key.endswith(f" {name}")), "")


def _parse(data: bytes, where: str, begin: Any, spaces: dict[str, str]) -> None:
    """Parse XML; ``begin`` gets the start of each element, ``spaces`` the namespaces by prefix."""
    parser = expat.ParserCreate(namespace_separator=" ")

    def refuse(*_: Any) -> None:
        raise FileFormatError(f"{where}: declares a document type, which 3MF forbids; export it again")

    def declare(prefix: str | None, uri: str) -> None:
        spaces[prefix or ""] = uri

    parser.StartDoctypeDeclHandler = refuse
    parser.StartNamespaceDeclHandler = declare
    parser.StartElementHandler = begin
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise FileFormatError(f"{where}: is no XML ({error}); the file is damaged, export it again") from None
    except (KeyError, ValueError, IndexError, OverflowError) as error:
        raise damaged(
            where, f"line {parser.CurrentLineNumber}: cannot be read ({type(error).__name__}: {error})"
        ) from None


def _key(name: str) -> str:
    """Names of parts are compared without regard to case."""
    return posixpath.normpath(name).lstrip("/").lower()


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write one object in the mesh's unit, or in meters where the file cannot name that; without one, millimeters."""
    meters = mesh.meters_per_unit
    unit, vertices = "millimeter", mesh.vertices
    if meters is not None:
        names = [name for name, value in _UNITS.items() if np.isclose(meters, value, rtol=1e-9, atol=0.0)]
        unit = names[0] if names else "meter"
        vertices = vertices if names else vertices * meters
    # Without characters that XML cannot hold.
    name = "".join(letter if letter.isprintable() else " " for letter in mesh.name or "mesh")
    head = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<model unit="{unit}" xml:lang="en-US" xmlns="{_CORE}2015/02">\n<resources>\n'
        f'<object id="1" type="model" name={quoteattr(name)}>\n<mesh>\n<vertices>\n'
    )
    points = written_rows('<vertex x="{}" y="{}" z="{}"/>\n', vertices)
    faces = written_rows('<triangle v1="{}" v2="{}" v3="{}"/>\n', mesh.faces)
    tail = '</triangles>\n</mesh>\n</object>\n</resources>\n<build>\n<item objectid="1"/>\n</build>\n</model>\n'
    # Level 4 is 2.5 times as fast as zlib's usual 6, for files 3 to 6 % larger.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        archive.writestr("[Content_Types].xml", _TYPES)
        archive.writestr("_rels/.rels", _RELATIONS)
        parts = head.encode(), *points, b"</vertices>\n<triangles>\n", *faces, tail.encode()
        archive.writestr(_USUAL, b"".join(parts))


_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
)
_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    f'<Relationship Target="/{_USUAL}" Id="rel0" Type="{_MODEL_RELATION}"/></Relationships>\n'
)
