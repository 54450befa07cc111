// The derivatives in a stretch, as integrals times powers of s; hook ON_STRETCH of emission.inl.
{
    // Light from behind the stretch.
    const double behind = total - unit * light;
    for (int k = 0; k < 4; ++k) {
        of_density[k] = -scale * span * (seen + glow * (behind + unit * lit[k])) / (double)(k + 1);
        of_light[k] = glow * unit * passed[k];
        passed[k] = 0.0;
        lit[k] = 0.0;
    }
    stretched += p0 * of_density[0] + p1 * of_density[1] + p2 * of_density[2] + p3 * of_density[3];
    end_density = p0 + p1 + p2 + p3;
    end_light = e0 + e1 + e2 + e3;
}
