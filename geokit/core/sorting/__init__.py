"""In what order do rows lie? Rows by their key, and rows in another order."""
