"""The mesh itself: positions, faces, attributes, materials, and a mesh that lies on a device."""
