"""The same commands for each of many files, in processes of one machine or of many."""
