"""Memory: how much there is, host and device arrays that kernels take, and the pools that use buffers again."""
