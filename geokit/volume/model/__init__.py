"""The volume itself: the bytes of one grid, what they say of themselves, and methods that forward to the verbs."""
