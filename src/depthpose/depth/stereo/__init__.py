"""Stereo matching: a rectified pair to disparity, by one of several matchers."""

from depthpose.depth.stereo.kinds import (
    MATCHERS,
    LightMatcher,
    MatcherKind,
    PSMNetMatcher,
    make_matcher,
)
from depthpose.depth.stereo.light import LightStereo
from depthpose.depth.stereo.matcher import (
    CallableMatcher,
    CameraMatcher,
    Matcher,
    SGBMMatcher,
    check_pair,
    fill_holes,
)
from depthpose.depth.stereo.network_matcher import (
    NetworkMatcher,
    StereoNetwork,
    normalise,
    tile_change_px,
    with_usable_precision,
)
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.published import import_psmnet, psmnet_from_published

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
