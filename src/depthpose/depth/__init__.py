"""Depth: a stereo pair, real or synthesised, to a metric depth map."""
