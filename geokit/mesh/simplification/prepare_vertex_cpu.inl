// The quadric of a vertex, and whether it must stay.
//
// Expects edge_quadrics_cpu.inl; v, EVENNESS.
#if !defined(__CUDA_ARCH__)
Ring ring;
bool locked = !ring_of(v, ring);
// Manifold: one fan of faces, whose edges have one or two of them.
int ends = 0;
for (int k = 0; k < ring.neighbor_count; ++k) {
    locked |= ring.uses[k] > 2;
    ends += ring.uses[k] == 1;
}
locked |= ends != 0 && ends != 2;
if (!locked && ring.face_count) {
    bool reached[MOST] = {true};
    int waiting[MOST] = {0}, count = 1, met = 1;
    while (count) {
        const int f = ring.faces[waiting[--count]];
        for (int k = 0; k < ring.face_count; ++k) {
            if (reached[k]) continue;
            int shared = 0;
            for (int i = 0; i < 3; ++i) shared += has_corner(ring.faces[k], face[3 * f + i]);
            if (shared < 2) continue;
            reached[k] = true;
            waiting[count++] = k;
            ++met;
        }
    }
    locked = met < ring.face_count;
}
state.locked.data[v] = locked || state.fixed.data[v];

double* const q = state.quadric.data + 10 * v;
const point p = position[v];
auto add_plane = [&](const point& n, double weight) {
    const double d = -wp::dot(n, p);
    const double row[4] = {n[0], n[1], n[2], d};
    const int at[10][2] = {{0, 0}, {0, 1}, {0, 2}, {1, 1}, {1, 2}, {2, 2}, {0, 3}, {1, 3}, {2, 3}, {3, 3}};
    for (int i = 0; i < 10; ++i) q[i] += weight * row[at[i][0]] * row[at[i][1]];
};
for (int k = 0; k < ring.face_count; ++k) {
    const int f = ring.faces[k];
    const point n = normal_of(corner_of(f, 0), corner_of(f, 1), corner_of(f, 2));
    const double length = wp::length(n);
    if (!(length > 0.0)) continue;
    add_plane(n / length, 0.5 * length);
    for (int i = 0; i < 3; ++i) {
        point axis(0.0, 0.0, 0.0);
        axis[i] = 1.0;
        add_plane(axis, 0.5 * length * EVENNESS);
    }
    // An open edge has a plane of its own, upright on the face.
    for (int j = 0; j < ring.neighbor_count; ++j) {
        if (ring.uses[j] != 1 || !has_corner(f, ring.neighbors[j])) continue;
        const point upright = wp::cross(position[ring.neighbors[j]] - p, n / length);
        const double size = wp::length(upright);
        if (size > 0.0) add_plane(upright / size, size * size);
    }
}
#endif
