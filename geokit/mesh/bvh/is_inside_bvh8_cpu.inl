// Whether the winding number around p exceeds 1/2 and p is not on the surface: a coarse sum first, then a fine one if
// the coarse sum is too close to 1/2.
//
// Expects winding_bvh8_cpu.inl; empty (half width of the cube outside of which nothing is inside, local); FAR, OPENING,
// OPENING_SIGN, SIGN_MARGIN, SIGN_SPREAD. Returns.
#if !defined(__CUDA_ARCH__)
// A point at a great distance, or one that overflowed in the local frame, has winding number zero.
if (!(size <= wp::min(empty, FAR))) return false;
float spread;
const double coarse = walk(OPENING_SIGN, &spread);
if (on_surface) return false;
const double doubt = coarse > 0.5 ? coarse - 0.5 : 0.5 - coarse;
if (doubt > SIGN_MARGIN + SIGN_SPREAD * spread) return coarse > 0.5;
return walk(OPENING, nullptr) > 0.5;
#endif
