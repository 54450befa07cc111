"""Which settings keep a distance field within a tolerance, with the least memory."""
