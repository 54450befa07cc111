"""Reading files with other libraries: in a separate process, or in this one where the user trusts the files."""
