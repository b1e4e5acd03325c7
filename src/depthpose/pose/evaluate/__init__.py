"""Predictions and truth to rows: metrics read files, and missing answers count as failures."""

from depthpose.pose.evaluate.errors import METRICS as METRICS
from depthpose.pose.evaluate.errors import Metric as Metric
from depthpose.pose.evaluate.errors import match as match
from depthpose.pose.evaluate.errors import nearest_copy as nearest_copy
from depthpose.pose.evaluate.evaluate import Evaluation as Evaluation
from depthpose.pose.evaluate.evaluate import evaluate as evaluate
from depthpose.pose.evaluate.evaluate import read_any as read_any
from depthpose.pose.evaluate.rows import Conditions as Conditions
from depthpose.pose.evaluate.rows import InstanceRow as InstanceRow
from depthpose.pose.evaluate.rows import ObjectRow as ObjectRow
from depthpose.pose.evaluate.rows import Origin as Origin
from depthpose.pose.evaluate.rows import RiskRow as RiskRow
from depthpose.pose.evaluate.summary import diameter_of as diameter_of
from depthpose.pose.evaluate.summary import frames_hash as frames_hash
from depthpose.pose.evaluate.summary import is_adds as is_adds
from depthpose.pose.evaluate.summary import of_targets as of_targets
