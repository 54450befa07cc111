"""Files that are read block after block: their content need not fit into memory."""
