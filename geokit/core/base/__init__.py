"""What everything stands on: forks, interrupts, private folders, caches and states of objects, text for terminals."""
