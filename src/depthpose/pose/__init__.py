"""Depth images and clouds of known objects to their 6-DoF poses, by registration or a network."""
