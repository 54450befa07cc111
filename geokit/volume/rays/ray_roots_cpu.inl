// The root iteration of raycast_cell.inl for eight cells at a time; spare lanes repeat the first cell.
//
// Expects the names of ray_packet_cpu.inl; the constants ROUNDS and RESOLUTION; hit, sx, sy and sz, whose entries it
// sets for the rays of the cells.
for (int n = found.count; n < ((found.count + 7) & ~7); ++n) {
    found.row[n] = found.row[0];
#define REPEAT(name) found.name[n] = found.name[0];
    BRACKET(REPEAT)
#undef REPEAT
}
for (int base = 0; base < found.count; base += 8) {
    double s[8], left_end[8], right_end[8], moved[8];
    int going[8];
    for (int n = 0; n < 8; ++n) {
        const double lo = found.lo[base + n], hi = found.hi[base + n], at_lo = found.at_lo[base + n];
        s[n] = lo + (hi - lo) * (at_lo / (at_lo - found.at_hi[base + n]));
        left_end[n] = lo;
        right_end[n] = hi;
        moved[n] = hi - lo;
        going[n] = 1;
    }
    for (int round = 0; round < ROUNDS; ++round) {
        int some = 0;
        for (int n = 0; n < 8; ++n) {
            const double p0 = found.p0[base + n], p1 = found.p1[base + n], p2 = found.p2[base + n];
            const double p3 = found.p3[base + n], at = s[n];
            const double v = ((p3 * at + p2) * at + p1) * at + p0;
            const bool on = (going[n] != 0) & !(v == 0.0), is_left = (v > 0.0) == (found.at_lo[base + n] > 0.0);
            const double left = is_left ? at : left_end[n], right = is_left ? right_end[n] : at;
            const double rise = (3.0 * p3 * at + 2.0 * p2) * at + p1, newton = at - v / rise;
            const bool quick = __builtin_fabs(newton - at) <= 0.5 * moved[n];
            const double better = ((newton >= left) & (newton <= right) & quick) ? newton : 0.5 * (left + right);
            left_end[n] = left;
            right_end[n] = right;
            moved[n] = __builtin_fabs(better - at);
            s[n] = on ? better : at;
            const int more = on & !(moved[n] <= RESOLUTION);
            going[n] = more;
            some |= more;
        }
        if (!some) break;
    }
    double t[8], x[8], y[8], z[8];
    for (int n = 0; n < 8; ++n) {
        const int m = base + n;
        t[n] = found.ta[m] + s[n] * (found.tb[m] - found.ta[m]);
        const double ux = found.ex[m] + s[n] * found.gx[m], uy = found.ey[m] + s[n] * found.gy[m];
        const double uz = found.ez[m] + s[n] * found.gz[m];
        x[n] = (found.kx[m] + uy * found.kxy[m]) + uz * (found.kxz[m] + uy * found.kxyz[m]);
        y[n] = (found.ky[m] + ux * found.kxy[m]) + uz * (found.kyz[m] + ux * found.kxyz[m]);
        z[n] = (found.kz[m] + ux * found.kxz[m]) + uy * (found.kyz[m] + ux * found.kxyz[m]);
    }
        #pragma clang loop vectorize(disable)
    for (int n = 0; n < 8; ++n) {
        const int q = found.row[base + n];
        hit[q] = rays.t0[q] + t[n];
        sx[q] = x[n];
        sy[q] = y[n];
        sz[q] = z[n];
    }
}
