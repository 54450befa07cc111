"""Threads and processes that work for a call, and what an interrupt of it leaves."""
