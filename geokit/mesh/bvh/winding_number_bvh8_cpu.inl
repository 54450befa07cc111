// The winding number around p.
//
// Expects winding_bvh8_cpu.inl; empty (half width of the cube outside of which the number is zero, local); FAR,
// OPENING. Returns the number as a double.
#if !defined(__CUDA_ARCH__)
// A point at a great distance, or one that overflowed in the local frame, has winding number zero.
if (!(size <= wp::min(empty, FAR))) return 0;
return walk(OPENING, nullptr);
#endif
