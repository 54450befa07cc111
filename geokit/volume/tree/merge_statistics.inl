// Box and extrema of the children `child` to `end` - 1.
//
// Expects child, end, boxes, extrema; T is the type of the values. Defines box, least, most, and some: whether any
// child has an active voxel.

int box[6] = {2147483647, 2147483647, 2147483647, -2147483647 - 1, -2147483647 - 1, -2147483647 - 1};
T least = 0, most = 0;
bool some = false;
for (; child < end; ++child) {
    const int* of = boxes.data + 6ll * child;
    if (of[0] > of[3]) continue;
    const T low = ((const T*)extrema.data)[2ll * child], high = ((const T*)extrema.data)[2ll * child + 1];
    least = !some || low < least ? low : least;
    most = !some || high > most ? high : most;
    some = true;
    for (int k = 0; k < 3; ++k) {
        box[k] = of[k] < box[k] ? of[k] : box[k];
        box[3 + k] = of[3 + k] > box[3 + k] ? of[3 + k] : box[3 + k];
    }
}
