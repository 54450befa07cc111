"""Level sets that change: redistancing, features, neighbors of leaves, morphology."""
