"""How kernels are launched at little cost: what calls have prepared, and warp's private parts."""
