"""``depthpose pose ...``."""
