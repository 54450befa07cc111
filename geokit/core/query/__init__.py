"""What happens to an array that a query is asked: one page, for all queries."""
