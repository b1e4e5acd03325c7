"""``depthpose data ...``: datasets that are made, checked, packed and labelled."""
