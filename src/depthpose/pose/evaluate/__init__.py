"""Predictions and truth to rows: metrics read files, and missing answers count as failures."""

from depthpose.pose.evaluate.detection import score_detections as score_detections
from depthpose.pose.evaluate.errors import METRICS as METRICS
from depthpose.pose.evaluate.errors import Metric as Metric
from depthpose.pose.evaluate.errors import find_nearest_copy as find_nearest_copy
from depthpose.pose.evaluate.errors import match_instances as match_instances
from depthpose.pose.evaluate.evaluate import Conditions as Conditions
from depthpose.pose.evaluate.evaluate import Evaluation as Evaluation
from depthpose.pose.evaluate.evaluate import InstanceRow as InstanceRow
from depthpose.pose.evaluate.evaluate import ObjectRow as ObjectRow
from depthpose.pose.evaluate.evaluate import Origin as Origin
from depthpose.pose.evaluate.evaluate import RiskRow as RiskRow
from depthpose.pose.evaluate.evaluate import evaluate as evaluate
from depthpose.pose.evaluate.evaluate import hash_frames as hash_frames
from depthpose.pose.evaluate.evaluate import prepare_errors as prepare_errors
from depthpose.pose.evaluate.evaluate import read_any_predictions as read_any_predictions
from depthpose.pose.evaluate.evaluate import select_targets as select_targets
