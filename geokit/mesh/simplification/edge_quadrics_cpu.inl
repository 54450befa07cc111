// What an edge collapse looks at: rings of vertices, and the place where a merged vertex has the least quadric error.
//
// Expects closest_on_triangle.inl (for `point`), state, MOST. Defines Ring, ring_of, has_corner, corner_of, normal_of,
// place_of, choose.
#if !defined(__CUDA_ARCH__)
// Faces and neighbors of a vertex, and how many of the faces each neighbor has.
struct Ring {
    int faces[MOST], neighbors[MOST], uses[MOST], face_count, neighbor_count;
    bool boundary;
};
int* const face = state.face.data;
point* const position = state.position.data;

auto has_corner = [&](int f, int v) { return face[3 * f] == v || face[3 * f + 1] == v || face[3 * f + 2] == v; };
auto corner_of = [&](int f, int k) -> const point& { return position[face[3 * f + k]]; };
auto normal_of = [](const point& a, const point& b, const point& c) { return wp::cross(b - a, c - a); };

// False for vertices with more than MOST faces or neighbors. Removed faces leave the list on the way.
auto ring_of = [&](int v, Ring& ring) {
    ring.face_count = ring.neighbor_count = 0;
    ring.boundary = false;
    int* link = state.first_corner.data + v;
    while (*link >= 0) {
        const int corner = *link, f = corner / 3;
        if (face[3 * f] < 0) {
            *link = state.next_corner.data[corner];
            continue;
        }
        link = state.next_corner.data + corner;
        if (ring.face_count == MOST) return false;
        ring.faces[ring.face_count++] = f;
        for (int i = 0; i < 3; ++i) {
            const int w = face[3 * f + i];
            if (w == v) continue;
            int k = 0;
            while (k < ring.neighbor_count && ring.neighbors[k] != w) ++k;
            if (k == MOST) return false;
            if (k == ring.neighbor_count) {
                ring.neighbors[ring.neighbor_count++] = w;
                ring.uses[k] = 0;
            }
            ++ring.uses[k];
        }
    }
    for (int k = 0; k < ring.neighbor_count; ++k) ring.boundary |= ring.uses[k] == 1;
    return true;
};

// A quadric is a symmetric matrix (six numbers), a vector and a number: x A x + 2 b x + c.
auto error_at = [](const double* q, const point& x) {
    return x[0] * (q[0] * x[0] + 2.0 * (q[1] * x[1] + q[2] * x[2] + q[6]))
           + x[1] * (q[3] * x[1] + 2.0 * (q[4] * x[2] + q[7])) + x[2] * (q[5] * x[2] + 2.0 * q[8]) + q[9];
};

// Where two vertices that become one have the least error, and the error there.
auto place_of = [&](int v, int w, point& x) {
    double q[10];
    for (int i = 0; i < 10; ++i) q[i] = state.quadric.data[10 * v + i] + state.quadric.data[10 * w + i];
    const double a = q[3] * q[5] - q[4] * q[4], b = q[2] * q[4] - q[1] * q[5], c = q[1] * q[4] - q[2] * q[3];
    const double d = q[0] * q[5] - q[2] * q[2], e = q[1] * q[2] - q[0] * q[4], f = q[0] * q[3] - q[1] * q[1];
    const double determinant = q[0] * a + q[1] * b + q[2] * c, trace = q[0] + q[3] + q[5];
    const int ends[2] = {v, w};
    const point middle = 0.5 * (position[v] + position[w]), edge = position[v] - position[w];
    const double length = wp::dot(edge, edge);
    if (determinant > SINGULAR * trace * trace * trace) {
        // From the middle of the edge, where less is lost to rounding.
        const point g(q[6] + q[0] * middle[0] + q[1] * middle[1] + q[2] * middle[2],
                      q[7] + q[1] * middle[0] + q[3] * middle[1] + q[4] * middle[2],
                      q[8] + q[2] * middle[0] + q[4] * middle[1] + q[5] * middle[2]);
        const point step(-(a * g[0] + b * g[1] + c * g[2]) / determinant,
                         -(b * g[0] + d * g[1] + e * g[2]) / determinant,
                         -(c * g[0] + e * g[1] + f * g[2]) / determinant);
        if (wp::dot(step, step) <= FARTHEST * length) {
            x = middle + step;
            // Corners of flat sides stay to the bit.
            for (int end : ends) {
                const point away = x - position[end];
                if (wp::dot(away, away) <= SAME_PLACE * length) x = position[end];
            }
            const double error = error_at(q, x);
            return error > 0.0 ? error : 0.0;
        }
    }
    x = middle;
    double least = error_at(q, middle);
    for (int end : ends) {
        const double error = error_at(q, position[end]);
        if (error < least) {
            least = error;
            x = position[end];
        }
    }
    return least > 0.0 ? least : 0.0;
};

// The cheapest edge of a vertex to one of higher number, after those that were tried in vain.
auto choose = [&](int v) {
    Ring ring;
    double least = INFINITY;
    int other = -1;
    if (!state.locked.data[v] && ring_of(v, ring)) {
        for (int k = 0; k < ring.neighbor_count; ++k) {
            const int w = ring.neighbors[k];
            if (w < v || state.locked.data[w]) continue;
            point x;
            const double error = place_of(v, w, x), tried = state.tried.data[v];
            if (error < tried || (error == tried && w <= state.tried_partner.data[v])) continue;
            if (error < least || (error == least && w < other)) {
                least = error;
                other = w;
            }
        }
    }
    state.error.data[v] = least;
    state.partner.data[v] = other;
};
#endif
