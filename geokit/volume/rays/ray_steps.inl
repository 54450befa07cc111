// Helpers for stepping a ray from one border to the next. Defines within and pick.
// The cell around a coordinate, clamped to the `count` cells from `low` on, because rounding may miss them.
auto within = [](double at, int low, int count) {
    const double above = at - (double)low;
    return low + (above < 0.0 ? 0 : above >= (double)count ? count - 1 : (int)above);
};
// The next border is unpredictable, so a conditional move is faster than a branch.
#if defined(__clang__) && !defined(__CUDA_ARCH__)
auto pick = [](bool which, auto one, auto other) { return __builtin_unpredictable(which) ? one : other; };
#else
auto pick = [](bool which, auto one, auto other) { return which ? one : other; };
#endif
