"""Estimates as files: ``poses.json`` keeps everything, BOP's csv the poses."""

from depthpose.pose.predictions.jobs import Job as Job
from depthpose.pose.predictions.jobs import detection_jobs as detection_jobs
from depthpose.pose.predictions.jobs import instance_jobs as instance_jobs
from depthpose.pose.predictions.jobs import predict as predict
from depthpose.pose.predictions.records import CLOUD as CLOUD
from depthpose.pose.predictions.records import PICTURE as PICTURE
from depthpose.pose.predictions.records import POSES as POSES
from depthpose.pose.predictions.records import STAGES as STAGES
from depthpose.pose.predictions.records import Place as Place
from depthpose.pose.predictions.records import Prediction as Prediction
from depthpose.pose.predictions.records import is_finished as is_finished
from depthpose.pose.predictions.records import is_started as is_started
from depthpose.pose.predictions.records import kept_predictions as kept_predictions
from depthpose.pose.predictions.records import parse_prediction as parse_prediction
from depthpose.pose.predictions.records import place_of as place_of
from depthpose.pose.predictions.records import prediction_row as prediction_row
from depthpose.pose.predictions.records import read_predictions as read_predictions
from depthpose.pose.predictions.records import score_of as score_of
from depthpose.pose.predictions.records import write_predictions as write_predictions
from depthpose.pose.predictions.results import alternatives_name as alternatives_name
from depthpose.pose.predictions.results import read_bop_results as read_bop_results
from depthpose.pose.predictions.results import results_name as results_name
from depthpose.pose.predictions.results import write_bop_results as write_bop_results
