// Recomputes the boxes of the nodes from those of the leaves' blocks.
//
// Expects count, children, block_boxes, boxes; WIDTH, NO_CHILD. Children have larger numbers than their parents: from
// the last node to the first, everything below a node is done before it.
for (int node = count - 1; node >= 0; --node) {
    for (int c = 0; c < WIDTH; ++c) {
        const int child = children.data[WIDTH * node + c];
        if (child == NO_CHILD) continue;
        for (int k = 0; k < 6; ++k) {
            float side;
            if (child < 0) side = block_boxes.data[6 * (-1 - child) + k];
            else {
                // Boxes of absent children are inverted, so that they widen nothing.
                const float* row = boxes.data + 48 * child + 8 * k;
                side = row[0];
                for (int j = 1; j < WIDTH; ++j) side = k < 3 ? wp::min(side, row[j]) : wp::max(side, row[j]);
            }
            boxes.data[48 * node + 8 * k + c] = side;
        }
    }
}
