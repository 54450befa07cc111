"""Sweeps towards failure, and the envelope that each method promises."""
