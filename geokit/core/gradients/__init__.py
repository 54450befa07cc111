"""Gradients of answers: tensors of torch that require them, tracers of jax and arrays on a tape of warp."""
