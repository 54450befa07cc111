"""Arrays and objects of other libraries."""
