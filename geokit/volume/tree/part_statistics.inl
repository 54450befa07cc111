// Box and extrema of a part of a node's children, which stand from first_child[node] on.
//
// Expects merge_statistics.inl, item, parts, first_child, boxes, extrema, out_boxes, out_extrema; T is the type of the
// values.

for (int k = 0; k < 6; ++k) out_boxes.data[6ll * item + k] = box[k];
((T*)out_extrema.data)[2ll * item] = least;
((T*)out_extrema.data)[2ll * item + 1] = most;
