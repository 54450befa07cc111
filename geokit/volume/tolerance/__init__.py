"""Distance fields that keep a tolerance with the least memory."""
