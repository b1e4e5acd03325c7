"""``depthpose reproduce ...`` and ``depthpose figure ...``."""
