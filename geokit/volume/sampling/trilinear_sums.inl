// The trilinear interpolant of a cell, or its gradient, or both. sample_kernels has the same sums for grids without a
// table; the answers agree to the last bit and must stay so.
//
// Expects c0 to c7, the cell's voxels, k fastest; x, y, z, the point's fractions in the cell; the macro GRADIENT, 0
// (value), 1 (gradient) or 2 (both); for gradients m00 to m22, world to index. Defines value; g0, g1, g2.
#if GRADIENT
// Differences come before averages, as in trilinear_slopes.
const double i_low = (c4 - c0) + ((c5 - c1) - (c4 - c0)) * z, i_high = (c6 - c2) + ((c7 - c3) - (c6 - c2)) * z;
const double j_low = (c2 - c0) + ((c3 - c1) - (c2 - c0)) * z, j_high = (c6 - c4) + ((c7 - c5) - (c6 - c4)) * z;
const double k_low = (c1 - c0) + ((c3 - c2) - (c1 - c0)) * y, k_high = (c5 - c4) + ((c7 - c6) - (c5 - c4)) * y;
const double di = i_low + (i_high - i_low) * y;
const double dj = j_low + (j_high - j_low) * x;
const double dk = k_low + (k_high - k_low) * x;
const double g0 = di * m00 + dj * m10 + dk * m20;
const double g1 = di * m01 + dj * m11 + dk * m21;
const double g2 = di * m02 + dj * m12 + dk * m22;
#endif
#if GRADIENT != 1
const double low_low = c0 + (c1 - c0) * z, low_high = c2 + (c3 - c2) * z;
const double high_low = c4 + (c5 - c4) * z, high_high = c6 + (c7 - c6) * z;
const double low = low_low + (low_high - low_low) * y, high = high_low + (high_high - high_low) * y;
const double value = low + (high - low) * x;
#endif
