"""Inside or outside: pseudonormals, winding numbers, parity of rays, and which of them a mesh allows."""
