"""What figures and pages share: checks of arguments, color maps, what a mesh says of its look."""
