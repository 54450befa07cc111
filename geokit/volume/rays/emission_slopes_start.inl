// Derivatives of transmittance and emission along a ray: what the hooks of emission.inl add up.
//
// The derivative by the density at a place is that of all light behind it, and the derivative by the emission is the
// transmittance up to it. In a stretch of the ray (s from 0 to 1) only their integrals times 1, s, s^2 and s^3 are
// needed, because the interpolant and all its derivatives are cubics of s. Of the light within the stretch these are
// sums over the Gauss points of the emission: so this is the exact derivative of the quadrature.
//
// Expects seen, the slope by the transmittance times the transmittance; glow, the slope by the emission; total, the
// emission; unit, world lengths in a unit of toward; scale, the extinction times unit.
double of_density[4], of_light[4];
double passed[4] = {0.0, 0.0, 0.0, 0.0}, lit[4] = {0.0, 0.0, 0.0, 0.0};
// Integrals over the ray of the gradient, of the gradient times the place along the ray, and of the density, each times
// its derivative; density and emission where the ray ends.
double along[3] = {0.0, 0.0, 0.0}, lever[3] = {0.0, 0.0, 0.0}, stretched = 0.0, end_density = 0.0, end_light = 0.0;
