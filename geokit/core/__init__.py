"""Shared foundations: arrays from callers, kernel launches, memory, files and C++ text."""
