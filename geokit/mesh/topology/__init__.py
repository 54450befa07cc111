"""How faces hang together: connectivity, orientation, measures of faces, merged vertices."""
