"""Tolerances: which settings keep a distance field within an error, with the least memory?"""
