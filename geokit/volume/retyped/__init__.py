"""The same tree with values of another type: codecs of fewer bits, and the channels of index grids."""
