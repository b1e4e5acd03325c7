"""``depthpose data ...``: data sets that are made, checked, packed and labelled."""
