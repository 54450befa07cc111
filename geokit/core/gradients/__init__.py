"""Gradients of answers: torch tensors that require gradients and jax tracers pass through queries."""
