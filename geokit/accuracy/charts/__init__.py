"""Charts of accuracy against speed: the settings that each one tries."""
