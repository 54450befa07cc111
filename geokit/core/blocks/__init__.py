"""The rows of a query in blocks: one after the other, or on several devices."""
