"""Named protocols to rows: predictions are files, metrics read files.

A protocol fixes the truth, the pixels that count and how the prediction is prepared. Numbers of
two protocols do not compare; every row carries its protocol's name.
"""

from depthpose.depth.evaluate.evaluate import Evaluation as Evaluation
from depthpose.depth.evaluate.evaluate import EvaluationRow as EvaluationRow
from depthpose.depth.evaluate.evaluate import Measured as Measured
from depthpose.depth.evaluate.evaluate import Row as Row
from depthpose.depth.evaluate.evaluate import evaluate as evaluate
from depthpose.depth.evaluate.evaluate import measure_frame as measure_frame
from depthpose.depth.evaluate.evaluate import ranking_metric as ranking_metric
from depthpose.depth.evaluate.evaluate import summarise as summarise
from depthpose.depth.evaluate.frames import PROTOCOLS as PROTOCOLS
from depthpose.depth.evaluate.frames import FrameResult as FrameResult
from depthpose.depth.evaluate.frames import Protocol as Protocol
from depthpose.depth.evaluate.frames import clamped_depth as clamped_depth
from depthpose.depth.evaluate.frames import find_protocol as find_protocol
from depthpose.depth.evaluate.frames import frame_result as frame_result
from depthpose.depth.evaluate.frames import has_truth as has_truth
