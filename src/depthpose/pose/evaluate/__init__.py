"""Predictions and truth to rows: metrics read files, and nothing leaves the denominator."""

from depthpose.pose.evaluate.errors import match as match
from depthpose.pose.evaluate.errors import nearest_copy as nearest_copy
from depthpose.pose.evaluate.evaluate import Evaluation as Evaluation
from depthpose.pose.evaluate.evaluate import evaluate as evaluate
from depthpose.pose.evaluate.evaluate import read_any as read_any
from depthpose.pose.evaluate.rows import diameter_of as diameter_of
from depthpose.pose.evaluate.rows import frames_hash as frames_hash
from depthpose.pose.evaluate.rows import is_adds as is_adds
from depthpose.pose.evaluate.rows import of_targets as of_targets
