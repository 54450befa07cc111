"""The interactive page: what a scene becomes in it, and the scripts that draw it in a browser."""
