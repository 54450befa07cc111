"""What mesh files say of their vertices, faces and corners besides positions, and what they can hold."""
