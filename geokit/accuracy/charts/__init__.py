"""Accuracy against speed: which settings each chart tries."""
