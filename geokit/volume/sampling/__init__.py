"""Sampling: which value and which derivatives does a volume have at a point?"""
