"""What geokit adds to other libraries, which find it by the entry points of pyproject.toml, or by register()."""
