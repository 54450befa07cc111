"""The demonstration: its input, its steps, its figures and its log."""
