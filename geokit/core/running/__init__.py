"""Threads and processes that work for a call."""
