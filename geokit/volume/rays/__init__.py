"""Where a ray first crosses an isovalue of a volume, and what the integrals of volumes along a ray are."""
