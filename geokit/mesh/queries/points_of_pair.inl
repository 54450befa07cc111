// Writes the nearest points of two triangles [world], one of each.
//
// Expects triangle_gap.inl; corners and slot of the surface, tree, other (a slot of the tree), unit; out_points.
point t[3], u[3], x, y;
for (int k = 0; k < 3; ++k) {
    t[k] = corners.data[3 * slot + k] * unit;
    u[k] = tree.corners.data[3 * other + k] * unit;
}
triangle_gap(t, u, x, y);
out_points.data[0] = x / unit;
out_points.data[1] = y / unit;
