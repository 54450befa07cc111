"""Trials: one method with one setting, its time, memory and error."""
