"""``depthpose reproduce ...`` and ``depthpose figure ...``: tables and figures of the thesis."""
