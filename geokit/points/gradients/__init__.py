"""How do distances between points change with the points?"""
