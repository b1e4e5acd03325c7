"""``depthpose depth ...``."""
