// Counting sort, last step: each point of a share goes to the next free position of its cell.
//
// Expects key, share, begin, end, cell_count, next_place, grid.
//
// Only four bytes a point are scattered.

#if !defined(__CUDA_ARCH__)
int* const next = next_place.data + (int64_t)(share)*cell_count;
for (int point = begin; point < end; ++point) grid.index.data[next[key.data[point]]++] = point;
#endif
