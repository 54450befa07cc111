# Files: grids as NanoVDB buffers, and headers.
from ._openvdb import read_vdb as read_vdb, write_vdb as write_vdb, inspect_vdb as inspect_vdb, VdbGrid as VdbGrid
from ._metadata import RawMetadata as RawMetadata

# Meshes and level sets.
from ._openvdb import mesh_to_level_set as mesh_to_level_set, volume_to_mesh as volume_to_mesh
from ._openvdb import PolygonMesh as PolygonMesh

# What was built.
from ._openvdb import available as available, require as require, versions as versions, build_facts as build_facts
