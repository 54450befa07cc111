"""The program around the commands: their names and examples, what it prints, exit codes."""
