"""What files of all formats have: the plain arrays of a body, and references to other files."""
