"""What scene files hold beside plain meshes. Standard library and NumPy only."""
