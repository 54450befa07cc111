"""Sweeps that run methods towards failure, the envelopes that they promise, and the page that shows both."""
