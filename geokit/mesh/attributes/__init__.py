"""What meshes carry on their vertices, faces and corners, and how it follows when these are renumbered."""
