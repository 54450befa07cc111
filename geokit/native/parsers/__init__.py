"""File parsers in C++: they need no OpenVDB."""
