// Greedy farthest point sampling: the part common to both devices.
//
// Expects cloud, start. Defines the arrays of the cloud by name, current (the next point to select) and keep_better.
//
// Both devices select the same point: the largest squared distance, among ties the lowest index. A leaf does not
// change, bit for bit, if its box is no nearer to the new point than the leaf's farthest point is to a selected one: no
// minimum inside would change. Leaves have 64 points, groups 64 leaves.

const double* const x = cloud.x.data;
const double* const y = cloud.y.data;
const double* const z = cloud.z.data;
double* const squared = cloud.squared.data;
const int* const index = cloud.index.data;
const int groups = cloud.group_count;
const int leaves = groups * 64;
const double* const leaf_box = cloud.leaf_box.data;
const double* const group_box = cloud.group_box.data;
double* const leaf_far = cloud.leaf_far.data;
double* const group_far = cloud.group_far.data;
int* const leaf_at = cloud.leaf_at.data;
int* const group_at = cloud.group_at.data;
const auto keep_better = [&](double& far, int& at, double other_far, int other_at) {
    if (other_at < 0) return;
    if (at < 0 || other_far > far || (other_far == far && index[other_at] < index[at])) {
        far = other_far;
        at = other_at;
    }
};
int current = start.data[0];
