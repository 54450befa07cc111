// A world box in a tree's local frame, rounded outward to float32.
//
// Expects BOX_PADDING, FARTHEST. Defines local_box(tree, lower, upper, low, high), low and high being three floats
// each, and rounded_down. Rounding is monotone: boxes that touch in the world touch here. The boxes of a warp Mesh are
// padded, because its vertices were rounded to nearest.
auto rounded_down = [](double x) { return (float)x - wp::abs((float)x) * 1.2e-7f - 1e-30f; };
auto local_box = [&](const auto& tree, const double* lower, const double* upper, float* low, float* high) {
    for (int k = 0; k < 3; ++k) {
        const double padding = tree.mesh ? BOX_PADDING : 0.0;
        const double from = (lower[k] - tree.origin[k]) / tree.scale - padding;
        const double to = (upper[k] - tree.origin[k]) / tree.scale + padding;
        low[k] = rounded_down(wp::clamp(from, -FARTHEST, FARTHEST));
        high[k] = -rounded_down(-wp::clamp(to, -FARTHEST, FARTHEST));
    }
};
