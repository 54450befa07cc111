"""Parts of simplify: edge collapse, the invariants that it must keep, and proven bounds of the deviation."""
