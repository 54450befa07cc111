"""Isosurfaces: which mesh represents the places where a volume takes a value?"""
