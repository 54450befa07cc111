"""Slow float64 answers in NumPy that charts and tests compare with. Shares no code with geokit."""
