// The entries of a matrix as separate variables.
//
// Expects to_index. Defines m00 to m22.
const double m00 = to_index.data[0][0], m01 = to_index.data[0][1], m02 = to_index.data[0][2];
const double m10 = to_index.data[1][0], m11 = to_index.data[1][1], m12 = to_index.data[1][2];
const double m20 = to_index.data[2][0], m21 = to_index.data[2][1], m22 = to_index.data[2][2];
