// Barycentric coordinates of the point of the triangle abc that is closest to p.
//
// Expects closest_on_triangle.inl and p, a, b, c. Returns the weights of a, b and c.
double v, w;
closest_on_triangle(p - a, b - a, c - a, v, w);
// Exactly zero on the edge opposite the first corner: a caller that looks up a normal must recognize the edge.
const double rest = 1.0 - w;
return point(v == rest ? 0.0 : rest - v, v, w);
