// Writes the derivatives by the ray if RAYS is 1; hook ON_END of emission.inl.
#if RAYS
for (int k = 0; k < 3; ++k) {
    out_along.data[ray][k] = along[k];
    out_lever.data[ray][k] = lever[k];
}
out_length.data[ray][0] = stretched;
// Beyond the box all is background, which is 0.
out_length.data[ray][1] = left ? 0.0 : glow * unit * wp::exp(-depth) * end_light - scale * seen * end_density;
#endif
