// Adds a Gauss point to the sums of a stretch; hook ON_LIGHT of emission.inl.
{
    const double e = e0 + s * (e1 + s * (e2 + s * e3));
    double share = span * step * weight[g] * through;
    for (int k = 0; k < 4; ++k) {
        passed[k] += share;
        share *= s;
        lit[k] += share * e;
    }
}
