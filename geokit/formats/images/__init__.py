"""Dense volumes: images of the field's formats, one module for each. Their lines in table.py name them."""
