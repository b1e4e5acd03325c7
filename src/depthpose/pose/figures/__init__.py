"""Figures 3-2, 3-4 and 3-5 of the thesis as pictures."""

from depthpose.pose.figures.canvas import arrange_grid as arrange_grid
from depthpose.pose.figures.features import draw_features as draw_features
from depthpose.pose.figures.features import seen_points as seen_points
from depthpose.pose.figures.field import draw_field as draw_field
from depthpose.pose.figures.tsne import embed_line as embed_line
