"""Surfaces of models and clouds: samples, nearest points, what a camera sees of them, grids."""
