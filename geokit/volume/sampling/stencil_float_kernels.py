"""The sums of :mod:`._stencil_kernels` for float grids, with their loops in C++.

Most grids hold floats. With the reading of a float inside the loops, and one accessor whose cached nodes serve all
look-ups of a stencil, they take half of the time that rows of any type take.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})

vec9d = wp.types.vector(length=9, dtype=wp.float64)


def _float_stencil(derivatives):
    """C++ for stencil_value, stencil_slopes and stencil_bends of a float grid, by the number of derivatives."""
    # The derivatives of the weights along i, j and k that each term of the result takes.
    terms = {
        0: [(0, 0, 0)],
        1: [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
        2: [(1, 0, 0), (0, 1, 0), (0, 0, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2), (0, 1, 1), (1, 0, 1), (1, 1, 0)],
    }[derivatives]
    shape = "double" if len(terms) == 1 else f"wp::vec_t<{len(terms)}, double>"
    entries = ["sums"] if len(terms) == 1 else [f"sums[{e}]" for e in range(len(terms))]
    rows = "\n".join(
        f"const double w{a}{b} = x.data[{a}][p] * y.data[{b}][q];" for a, b in sorted({t[:2] for t in terms})
    )
    orders = range(derivatives + 1)
    return f"""
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    struct Node {{ unsigned long long begin, step; }};
    // Where the first voxel of a leaf is, and how far apart voxels are: those of a tile are all in one place.
    auto node_of = [&](int a, int b, int c) -> Node {{
        const pnanovdb_coord_t ijk = {{ a, b, c }};
        unsigned level;
        const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
            PNANOVDB_GRID_TYPE_FLOAT, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
        if (level != 0u) return {{ at.byte_offset, 0u }};
        return {{ pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, accessor.leaf, 0u).byte_offset, 4u }};
    }};
    auto voxel = [&](Node node, unsigned n) -> double {{
        const pnanovdb_address_t at = {{ node.begin + n * node.step }};
        return (double)pnanovdb_read_float(buf, at);
    }};
    const int cut_j = wp::min(count, 8 - (j & 7)), cut_k = wp::min(count, 8 - (k & 7));
    const unsigned own = (unsigned)(((i + 1) & 7) << 6 | ((j + 1) & 7) << 3 | ((k + 1) & 7));
    const double centre = voxel(node_of(i + 1, j + 1, k + 1), own);
    {shape} sums = {{}};
    Node n00, n01, n10, n11;
    for (int p = 0; p < count; ++p) {{
        if (p == 0 || ((i + p) & 7) == 0) {{
            n00 = node_of(i + p, j, k);
            n01 = cut_k < count ? node_of(i + p, j, k + cut_k) : n00;
            n10 = cut_j < count ? node_of(i + p, j + cut_j, k) : n00;
            n11 = cut_j < count ? (cut_k < count ? node_of(i + p, j + cut_j, k + cut_k) : n10) : n01;
        }}
        for (int q = 0; q < count; ++q) {{
            const Node near = q < cut_j ? n00 : n10, far = q < cut_j ? n01 : n11;
            const unsigned n = (unsigned)(((i + p) & 7) << 6 | ((j + q) & 7) << 3);
            double {", ".join(f"r{o} = 0.0" for o in orders)};
            for (int s = 0; s < count; ++s) {{
                const double value = voxel(s < cut_k ? near : far, n + (unsigned)((k + s) & 7)) - centre;
                {" ".join(f"r{o} += z.data[{o}][s] * value;" for o in orders)}
            }}
            {rows}
            {" ".join(f"{entry} += w{a}{b} * r{c};" for entry, (a, b, c) in zip(entries, terms, strict=True))}
        }}
    }}
    return {"centre + " if derivatives == 0 else ""}sums;
    """


@wp.func_native(_float_stencil(0))
def float_value(
    volume: wp.uint64, i: int, j: int, k: int, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d
) -> wp.float64:
    """stencil_value of a float grid, from the voxel (i, j, k) on."""
    ...


@wp.func_native(_float_stencil(1))
def float_slopes(
    volume: wp.uint64, i: int, j: int, k: int, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d
) -> wp.vec3d:
    """stencil_slopes of a float grid."""
    ...


@wp.func_native(_float_stencil(2))
def float_bends(
    volume: wp.uint64, i: int, j: int, k: int, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d
) -> vec9d:
    """stencil_bends of a float grid: first and second derivatives, those of the pairs (j, k), (i, k) and (i, j)."""
    ...
