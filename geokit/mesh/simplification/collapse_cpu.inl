// Edge collapse by quadric errors: see collapse_cpu_kernels.
#include "mesh/triangle/closest.inl"

// Faces and neighbors of a vertex, and how many of the faces each neighbor has.
struct Ring {
    int faces[MOST], neighbors[MOST], uses[MOST], face_count, neighbor_count;
    bool boundary;
};

static constexpr auto has_corner = [](const Decimation& state, int f, int v) {
    const int* c = state.face.data + 3 * f;
    return c[0] == v || c[1] == v || c[2] == v;
};
static constexpr auto corner_of = [](const Decimation& state, int f, int k) -> const point& {
    return state.position.data[state.face.data[3 * f + k]];
};
static constexpr auto normal_of = [](const point& a, const point& b, const point& c) {
    return wp::cross(b - a, c - a);
};

// False for vertices with more than MOST faces or neighbors. Removed faces leave the list on the way.
static constexpr auto ring_of = [](const Decimation& state, int v, Ring& ring) {
    const int* const face = state.face.data;
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
static constexpr auto error_at = [](const double* q, const point& x) {
    return x[0] * (q[0] * x[0] + 2.0 * (q[1] * x[1] + q[2] * x[2] + q[6]))
           + x[1] * (q[3] * x[1] + 2.0 * (q[4] * x[2] + q[7])) + x[2] * (q[5] * x[2] + 2.0 * q[8]) + q[9];
};

// Where two vertices that become one have the least error, and the error there.
static constexpr auto place_of = [](const Decimation& state, int v, int w, point& x) {
    const point* const position = state.position.data;
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
static constexpr auto choose = [](int v, const Decimation& state) {
    Ring ring;
    double least = INFINITY;
    int other = -1;
    if (!state.locked.data[v] && ring_of(state, v, ring)) {
        for (int k = 0; k < ring.neighbor_count; ++k) {
            const int w = ring.neighbors[k];
            if (w < v || state.locked.data[w]) continue;
            point x;
            const double error = place_of(state, v, w, x), tried = state.tried.data[v];
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

// The quadric of a vertex, and whether it must stay.
static constexpr auto prepare = [](int v, const Decimation& state) {
    const int* const face = state.face.data;
    const point* const position = state.position.data;
    Ring ring;
    bool locked = !ring_of(state, v, ring);
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
                for (int i = 0; i < 3; ++i) shared += has_corner(state, ring.faces[k], face[3 * f + i]);
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
        const point n = normal_of(corner_of(state, f, 0), corner_of(state, f, 1), corner_of(state, f, 2));
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
            if (ring.uses[j] != 1 || !has_corner(state, f, ring.neighbors[j])) continue;
            const point upright = wp::cross(position[ring.neighbors[j]] - p, n / length);
            const double size = wp::length(upright);
            if (size > 0.0) add_plane(upright / size, size * size);
        }
    }
};

// Collapses edges of a part, the least error first, as long as each keeps the topology, flips no face and stays within
// the limit. `steps` edges are tried, until as few faces are left as are wanted. All that a collapse reads or writes lies
// in its part, but for places of vertices that stay.
static constexpr auto collapse = [](int part, int steps, double worst, const Decimation& state) {
    int* const face = state.face.data;
    point* const position = state.position.data;
    int* const heap = state.heap.data + state.heap_begin.data[part];
    int* const place = state.heap_place.data;
    int* const count = state.count.data + COUNTS * part;
    int &heap_size = count[0], &live = count[1], &logged = count[4], &next = count[6];
    const int wanted = count[2], again = count[5];
    int *const log = state.log.data + state.heap_begin.data[part], *const changed = state.changed.data;
    const bool limited = state.limit.shape[0] > 0;

    // The heap holds vertices, by the error of the edge that each has chosen.
    auto before = [&](int a, int b) {
        const double one = state.error.data[a], other = state.error.data[b];
        return one < other || (one == other && a < b);
    };
    auto put = [&](int at, int v) {
        heap[at] = v;
        place[v] = at;
    };
    auto up = [&](int at) {
        const int v = heap[at];
        for (; at && before(v, heap[(at - 1) / 2]); at = (at - 1) / 2) put(at, heap[(at - 1) / 2]);
        put(at, v);
    };
    auto down = [&](int at) {
        const int v = heap[at];
        for (;;) {
            int child = 2 * at + 1;
            if (child + 1 < heap_size && before(heap[child + 1], heap[child])) ++child;
            if (child >= heap_size || !before(heap[child], v)) break;
            put(at, heap[child]);
            at = child;
        }
        put(at, v);
    };
    auto sort_in = [&](int v) {
        if (state.partner.data[v] < 0) {
            const int at = place[v];
            if (at < 0) return;
            place[v] = -1;
            const int last = heap[--heap_size];
            if (last == v) return;
            put(at, last);
            up(at);
            down(place[last]);
            return;
        }
        if (place[v] < 0) put(heap_size++, v);
        up(place[v]);
        down(place[v]);
    };

    // The faces around the new vertex, and the faces that they replace or change.
    struct Fan {
        point corners[2 * MOST][3];
        int faces[2 * MOST], count;
    } fan;
    Ring around, there;
    const Ring* const rings[2] = {&around, &there};
    int kept = -1, gone = -1;

    auto squared_distance = [&](const point& p, const point& a, const point& b, const point& c) {
        double v, w;
        return closest_on_triangle(p - a, b - a, c - a, v, w);
    };
    // The squared limit around a sample.
    auto limit_at = [&](int s) { return state.limit.data[state.sample_face.data[s]]; };
    auto near_fan = [&](int s, int k) {
        const point* c = fan.corners[k];
        return squared_distance(state.sample.data[s], c[0], c[1], c[2]) <= limit_at(s);
    };
    auto near_input = [&](const point& p, int s) {
        const int* c = state.input_face.data + 3 * state.sample_face.data[s];
        const point* input = state.input_position.data;
        return squared_distance(p, input[c[0]], input[c[1]], input[c[2]]) <= limit_at(s);
    };
    // The new face that an old one becomes; -1 for those that vanish.
    auto becomes = [&](int f) {
        for (int k = 0; k < fan.count; ++k)
            if (fan.faces[k] == f) return k;
        return -1;
    };
    // Calls for the samples of all faces around the edge, until a call returns true.
    auto any_sample = [&](auto&& call) {
        for (const Ring* ring : rings)
            for (int k = 0; k < ring->face_count; ++k) {
                const int f = ring->faces[k];
                if (ring == &there && has_corner(state, f, kept)) continue;
                const int own = becomes(f);
                for (int s = state.first_sample.data[f]; s >= 0; s = state.next_sample.data[s])
                    if (call(s, own)) return true;
            }
        return false;
    };

    // The link condition: what both ends of the edge touch, the edge itself touches.
    auto keeps_topology = [&]() {
        int opposite[2], shared = 0, common = 0;
        for (int k = 0; k < around.face_count; ++k) {
            const int f = around.faces[k];
            if (!has_corner(state, f, gone)) continue;
            if (shared == 2) return false;
            opposite[shared++] = face[3 * f] + face[3 * f + 1] + face[3 * f + 2] - kept - gone;
        }
        for (int k = 0; k < around.neighbor_count; ++k)
            for (int j = 0; j < there.neighbor_count; ++j) common += around.neighbors[k] == there.neighbors[j];
        if (shared == 0 || common != shared) return false;
        // Both on boundaries and the edge inside, or the last triangle of a part.
        int met[2] = {0, 0}, open = 0;
        for (int i = 0; i < 2; ++i) {
            const Ring& ring = i ? there : around;
            for (int k = 0; k < ring.face_count; ++k)
                met[i] += shared == 2 && has_corner(state, ring.faces[k], opposite[0])
                          && has_corner(state, ring.faces[k], opposite[1]);
            for (int k = 0; k < ring.neighbor_count; ++k) open += ring.neighbors[k] == opposite[0] && ring.uses[k] == 1;
        }
        return shared == 2 ? !(around.boundary && there.boundary) && !(met[0] && met[1]) : open < 2;
    };

    auto input_normal = [&](int f) {
        const int* c = state.input_face.data + 3 * f;
        const point* input = state.input_position.data;
        return normal_of(input[c[0]], input[c[1]], input[c[2]]);
    };
    // Lists the new faces; false if one would turn over or lose its area.
    auto keeps_facing = [&](const point& x) {
        fan.count = 0;
        for (const Ring* ring : rings)
            for (int k = 0; k < ring->face_count; ++k) {
                const int f = ring->faces[k];
                if (has_corner(state, f, kept) && has_corner(state, f, gone)) continue;
                point* corners = fan.corners[fan.count];
                for (int i = 0; i < 3; ++i) {
                    const int c = face[3 * f + i];
                    corners[i] = c == kept || c == gone ? x : position[c];
                }
                const point was = normal_of(corner_of(state, f, 0), corner_of(state, f, 1), corner_of(state, f, 2));
                const point is = normal_of(corners[0], corners[1], corners[2]);
                const double both = wp::dot(was, is);
                const double area = wp::dot(is, is);
                if (!(both > 0.0) || !(both * both > FLAT * wp::dot(was, was) * area)) return false;
                // Without samples that say what the input is like there, a face is compared with what it was.
                if (!limited && !(wp::dot(is, input_normal(f)) >= 0.0)) return false;
                double longest = 0.0;
                for (int i = 0; i < 3; ++i) {
                    const point edge = corners[(i + 1) % 3] - corners[i];
                    longest = wp::max(longest, wp::dot(edge, edge));
                }
                if (!(area > THIN * longest * longest)) return false;
                fan.faces[fan.count++] = f;
            }
        return fan.count > 0;
    };

    // The sample that is nearest to a point; -1 for none.
    auto sample_near = [&](const point& p) {
        int nearest = -1;
        double least = INFINITY;
        any_sample([&](int s, int) {
            const point away = state.sample.data[s] - p;
            const double squared = wp::dot(away, away);
            if (squared < least) {
                least = squared;
                nearest = s;
            }
            return false;
        });
        return nearest;
    };
    // Whether the input has a face within the limit: that of the nearest sample, or else any around the edge.
    auto is_near_input = [&](const point& p) {
        const int s = sample_near(p);
        return s >= 0 && (near_input(p, s) || any_sample([&](int other, int) { return near_input(p, other); }));
    };
    // Faces may turn little by little: so they are also compared with the input.
    auto faces_as_input = [&](const point* c) {
        const int s = sample_near((c[0] + c[1] + c[2]) / 3.0);
        if (s < 0) return false;
        return wp::dot(normal_of(c[0], c[1], c[2]), input_normal(state.sample_face.data[s])) >= 0.0;
    };
    // Samples of the input against the new faces; the new vertex and points of the new faces against the input.
    auto keeps_limit = [&](const point& x) {
        const bool far = any_sample([&](int s, int own) {
            if (own >= 0 && near_fan(s, own)) return false;
            for (int k = 0; k < fan.count; ++k)
                if (near_fan(s, k)) return false;
            return true;
        });
        if (far || !is_near_input(x)) return false;
        for (int k = 0; k < fan.count; ++k) {
            const point* c = fan.corners[k];
            if (!faces_as_input(c)) return false;
            int at = 0;
            for (int i = 0; i < 3; ++i)
                if (face[3 * fan.faces[k] + i] == kept || face[3 * fan.faces[k] + i] == gone) at = i;
            // A lattice of barycentric weights, without the outer edge and the one that the next face has too.
            for (int i = 1; i < LATTICE; ++i)
                for (int j = 1; j <= LATTICE - i; ++j) {
                    const double u = (double)i / LATTICE, v = (double)j / LATTICE;
                    if (!is_near_input(u * x + v * c[(at + 1) % 3] + (1.0 - u - v) * c[(at + 2) % 3])) return false;
                }
        }
        return true;
    };
    // Samples that are not well within the limit of the face that they had go to the nearest new one.
    auto share_samples = [&]() {
        int loose = -1;
        for (const Ring* ring : rings)
            for (int k = 0; k < ring->face_count; ++k) {
                const int f = ring->faces[k];
                if (ring == &there && has_corner(state, f, kept)) continue;
                const int own = becomes(f);
                int* link = state.first_sample.data + f;
                while (*link >= 0) {
                    const int s = *link;
                    const point* c = fan.corners[own < 0 ? 0 : own];
                    if (own >= 0
                        && squared_distance(state.sample.data[s], c[0], c[1], c[2]) <= WELL_WITHIN * limit_at(s)) {
                        link = state.next_sample.data + s;
                        continue;
                    }
                    *link = state.next_sample.data[s];
                    state.next_sample.data[s] = loose;
                    loose = s;
                }
            }
        while (loose >= 0) {
            const int s = loose;
            loose = state.next_sample.data[s];
            int nearest = 0;
            double least = INFINITY;
            for (int k = 0; k < fan.count; ++k) {
                const point* c = fan.corners[k];
                const double squared = squared_distance(state.sample.data[s], c[0], c[1], c[2]);
                if (squared < least) {
                    least = squared;
                    nearest = fan.faces[k];
                }
            }
            state.next_sample.data[s] = state.first_sample.data[nearest];
            state.first_sample.data[nearest] = s;
        }
    };

    // To the place of least error, or as logged: where nothing has changed around, that keeps the limit.
    auto collapse = [&](bool is_logged) {
        if (!ring_of(state, kept, around) || !ring_of(state, gone, there) || !keeps_topology()) return false;
        bool is_new = !is_logged;
        for (const Ring* ring : rings)
            for (int k = 0; k < ring->neighbor_count; ++k) is_new |= changed[ring->neighbors[k]] != 0;
        point x = state.new_place.data[gone];
        if (!is_logged) place_of(state, kept, gone, x);
        if (!keeps_facing(x) || (limited && is_new && !keeps_limit(x))) return false;
        if (limited) share_samples();
        log[logged++] = gone;
        state.into.data[gone] = kept;
        state.new_place.data[gone] = x;
        position[kept] = x;
        for (int i = 0; i < 10; ++i) state.quadric.data[10 * kept + i] += state.quadric.data[10 * gone + i];
        for (int k = 0; k < there.face_count; ++k) {
            const int f = there.faces[k];
            if (has_corner(state, f, kept)) {
                face[3 * f] = -1;
                --live;
                continue;
            }
            for (int i = 0; i < 3; ++i) {
                if (face[3 * f + i] != gone) continue;
                face[3 * f + i] = kept;
                state.next_corner.data[3 * f + i] = state.first_corner.data[kept];
                state.first_corner.data[kept] = 3 * f + i;
            }
        }
        state.first_corner.data[gone] = -1;
        state.locked.data[gone] = 1;
        return true;
    };
    auto choose_again = [&](int v) {
        state.tried.data[v] = -1.0;
        choose(v, state);
        sort_in(v);
    };

    auto goes_on = [&]() { return next < again || (heap_size && live > wanted && state.error.data[heap[0]] <= worst); };
    for (int step = 0; step < steps && goes_on(); ++step) {
        if (next < again) {
            gone = log[next++];
            kept = state.into.data[gone];
            if (changed[kept] == SKIPPED || changed[gone] == SKIPPED || !collapse(true))
                changed[kept] = changed[gone] = SKIPPED;
            continue;
        }
        kept = heap[0];
        gone = state.partner.data[kept];
        if (!collapse(false)) {
            state.tried.data[kept] = state.error.data[kept];
            state.tried_partner.data[kept] = gone;
            choose(kept, state);
            sort_in(kept);
            continue;
        }
        choose_again(gone);
        choose_again(kept);
        ring_of(state, kept, around);
        for (int k = 0; k < around.neighbor_count; ++k) {
            const int v = around.neighbors[k];
            if (state.locked.data[v]) continue;
            if (state.tried.data[v] >= 0.0 || state.partner.data[v] == kept || state.partner.data[v] == gone) {
                choose_again(v);
            } else if (v < kept) {
                // Of its edges only this one has another error.
                point x;
                const double error = place_of(state, v, kept, x), chosen = state.error.data[v];
                if (error > chosen || (error == chosen && kept > state.partner.data[v])) continue;
                state.error.data[v] = error;
                state.partner.data[v] = kept;
                sort_in(v);
            }
        }
    }
    count[3] = goes_on();
};
