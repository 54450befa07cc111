// An active tile and those below it: which of them may have crossed cells.
//
// Expects blocks_around.inl. Returns them as bits by direction.

look_around((int*)0);
int rims = 0;
for (int e = 0; e < 8; ++e) if (is_rim(e, false, false)) rims |= 1 << e;
return rims;
