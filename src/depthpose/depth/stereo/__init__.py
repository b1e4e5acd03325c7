"""Stereo matching: a rectified pair to disparity, by one of several matchers."""

from depthpose.depth.stereo.light import LightStereo
from depthpose.depth.stereo.light_matcher import LightMatcher
from depthpose.depth.stereo.matcher import (
    CallableMatcher,
    CameraMatcher,
    Matcher,
    check_pair,
)
from depthpose.depth.stereo.network_matcher import (
    NetworkMatcher,
    StereoNetwork,
    normalise,
    tile_change_px,
    with_usable_precision,
)
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.psmnet_matcher import PSMNetMatcher
from depthpose.depth.stereo.published import import_psmnet, psmnet_from_published
from depthpose.depth.stereo.registry import MATCHERS, MatcherKind, make_matcher
from depthpose.depth.stereo.sgbm import SGBMMatcher, fill_holes

__all__ = [
    "MATCHERS",
    "CallableMatcher",
    "CameraMatcher",
    "LightMatcher",
    "LightStereo",
    "Matcher",
    "MatcherKind",
    "NetworkMatcher",
    "PSMNet",
    "PSMNetMatcher",
    "SGBMMatcher",
    "StereoNetwork",
    "check_pair",
    "fill_holes",
    "import_psmnet",
    "make_matcher",
    "normalise",
    "psmnet_from_published",
    "tile_change_px",
    "with_usable_precision",
]
