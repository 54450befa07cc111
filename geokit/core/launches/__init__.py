"""How kernels are launched at little cost: prepared launches, replays of small queries, and warp's private parts."""
