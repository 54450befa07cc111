"""Inside or outside: pseudonormals, winding numbers, parity of rays, and the choice between them."""
