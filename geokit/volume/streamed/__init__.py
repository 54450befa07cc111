"""How does a mesh that does not fit into memory become a narrow band: cell after cell, into one file?"""
