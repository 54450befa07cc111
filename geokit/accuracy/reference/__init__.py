"""Independent reference answers in float64 NumPy for charts and tests: slow, and without code shared with geokit."""
