// How a ray goes from one border to the next. Defines within and pick.
    // The cell around a coordinate among those from `low` on; rounding must not put it anywhere else.
    auto within = [](double at, int low, int count) {
        const double above = at - (double)low;
        return low + (above < 0.0 ? 0 : above >= (double)count ? count - 1 : (int)above);
    };
    // Which border is next cannot be predicted: a selection is quicker than a branch.
#if defined(__clang__) && !defined(__CUDA_ARCH__)
    auto pick = [](bool which, auto one, auto other) { return __builtin_unpredictable(which) ? one : other; };
#else
    auto pick = [](bool which, auto one, auto other) { return which ? one : other; };
#endif
