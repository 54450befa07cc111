"""What every room stands on: arrays from outside, kernel launches, memory, files, C++ text."""
