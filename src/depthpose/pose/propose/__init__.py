"""Proposals of poses: a network's keypoints, point pairs of a cloud, and of a whole image."""

from depthpose.pose.propose.keypoints import find_consistent_keypoints as find_consistent_keypoints
from depthpose.pose.propose.keypoints import fit_pose as fit_pose
from depthpose.pose.propose.keypoints import fit_poses as fit_poses
from depthpose.pose.propose.keypoints import meet_lines as meet_lines
from depthpose.pose.propose.keypoints import vote_ransac as vote_ransac
