"""The depth room: a stereo pair, real or synthesised, to a metric depth map."""
