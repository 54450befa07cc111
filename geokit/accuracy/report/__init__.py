"""Reports of measurements: a folder with tables, figures and one HTML page."""
