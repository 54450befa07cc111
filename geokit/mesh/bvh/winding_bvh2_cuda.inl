// The winding number around a point on CUDA, by warp's own tree of solid angles.
//
// Expects tree, winding, empty (half width of the cube outside of which the number is zero, local), p; FAR, ACCURACY;
// and the macro RESULT(sum), which gives the value to return. Returns.
#if defined(__CUDA_ARCH__)
const wp::vec_t<3, wp::float64> q = (p - tree.origin) / tree.scale;
const double size = wp::max(wp::max(wp::abs(q[0]), wp::abs(q[1])), wp::abs(q[2]));
// A point at a great distance, or one that overflowed in the local frame, has winding number zero.
if (!(size <= wp::min(empty, FAR))) return 0;
return RESULT(wp::mesh_query_winding_number(winding.mesh, wp::vec3(q[0], q[1], q[2]), ACCURACY));
#endif
