// Finds which of an active tile and the tiles below it may have crossed cells.
//
// Expects blocks_around.inl. Returns a bit mask by direction.

look_around((int*)0);
int rims = 0;
for (int e = 0; e < 8; ++e) if (is_rim(e, false, false)) rims |= 1 << e;
return rims;
