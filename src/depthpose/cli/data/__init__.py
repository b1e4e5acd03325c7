"""``depthpose data ...``."""
