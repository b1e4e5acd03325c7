"""``depthpose pose ...``: options, and what its commands do with them."""
