// Finds which of eight tiles may have crossed cells: an active one and its neighbors towards lower indices.
//
// Expects blocks_around.inl. Returns a bit mask by direction.

look_around((int*)0);
int below = 0;
for (int e = 0; e < 8; ++e)
    if (is_border(e, false, false)) below |= 1 << e;
return below;
