"""Values and derivatives of volumes at points: nearest, trilinear, quadratic, cubic, staggered."""
