"""Pinhole camera and rectified stereo rig."""

from depthpose.core.camera.any_camera import AnyCamera as AnyCamera
from depthpose.core.camera.any_camera import AnyLens as AnyLens
from depthpose.core.camera.any_camera import FieldOfView as FieldOfView
from depthpose.core.camera.any_camera import camera_of as camera_of
from depthpose.core.camera.any_camera import choose_lens as choose_lens
from depthpose.core.camera.any_camera import refuse_unusable_focal as refuse_unusable_focal
from depthpose.core.camera.formats.camera_fields import CAMERA_SUFFIXES as CAMERA_SUFFIXES
from depthpose.core.camera.formats.camera_file import (
    check_image_matches_camera as check_image_matches_camera,
)
from depthpose.core.camera.formats.camera_file import read_camera as read_camera
from depthpose.core.camera.formats.camera_file import read_rig as read_rig
from depthpose.core.camera.formats.camera_file import write_camera as write_camera
from depthpose.core.camera.formats.facts import (
    describe_suspicious_centre as describe_suspicious_centre,
)
from depthpose.core.camera.formats.facts import refuse_other_resolution as refuse_other_resolution
from depthpose.core.camera.formats.facts import refuse_outside as refuse_outside
from depthpose.core.camera.pinhole import Camera as Camera
from depthpose.core.camera.pinhole import StereoRig as StereoRig
from depthpose.core.camera.pinhole import back_project as back_project
from depthpose.core.camera.pinhole import crop_camera as crop_camera
from depthpose.core.camera.pinhole import pixel_grid as pixel_grid
from depthpose.core.camera.pinhole import project as project
from depthpose.core.camera.pinhole import resize_camera as resize_camera
from depthpose.core.camera.rectified import RectificationReport as RectificationReport
from depthpose.core.camera.rectified import check_rectified as check_rectified
from depthpose.core.camera.rectify import RawCamera as RawCamera
from depthpose.core.camera.rectify import RawPair as RawPair
from depthpose.core.camera.rectify import Rectifier as Rectifier
from depthpose.core.camera.rectify import make_rectifier as make_rectifier
from depthpose.core.camera.rectify import read_raw_pair as read_raw_pair
from depthpose.core.camera.two_views import find_two_views as find_two_views
from depthpose.core.camera.two_views import order_views as order_views
from depthpose.core.camera.two_views import split_halves as split_halves
