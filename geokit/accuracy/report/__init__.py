"""Results as a folder that a person can read: tables, figures, one page."""
