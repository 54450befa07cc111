"""Parts of simplify: edge collapse, what it must not change, and proven bounds of the deviation."""
