"""``depthpose depth ...``: options, and what its commands do with them."""
