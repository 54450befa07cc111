"""Rays: where does a ray first cross an isovalue of a volume, and what are the integrals along it?"""
