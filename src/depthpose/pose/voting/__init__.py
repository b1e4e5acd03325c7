"""Directions to keypoints to pose: least squares, RANSAC, rigidity, Kabsch, covariances."""

from depthpose.pose.voting.lines import meet_lines as meet_lines
from depthpose.pose.voting.pose import consistent_keypoints as consistent_keypoints
from depthpose.pose.voting.pose import distance_errors as distance_errors
from depthpose.pose.voting.pose import fit_pose as fit_pose
from depthpose.pose.voting.pose import free_motions as free_motions
from depthpose.pose.voting.ransac import vote_ransac as vote_ransac
