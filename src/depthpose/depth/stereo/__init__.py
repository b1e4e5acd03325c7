"""Stereo matching: a rectified pair to disparity, by one of several matchers."""

from depthpose.depth.stereo.light import LightMatcher as LightMatcher
from depthpose.depth.stereo.light import LightStereo as LightStereo
from depthpose.depth.stereo.matcher import CallableMatcher as CallableMatcher
from depthpose.depth.stereo.matcher import Matcher as Matcher
from depthpose.depth.stereo.matcher import SGBMMatcher as SGBMMatcher
from depthpose.depth.stereo.matcher import check_views as check_views
from depthpose.depth.stereo.matcher import fill_holes as fill_holes
from depthpose.depth.stereo.matcher import infinity_px as infinity_px
from depthpose.depth.stereo.matcher import match_from_infinity as match_from_infinity
from depthpose.depth.stereo.matcher import move_match_back as move_match_back
from depthpose.depth.stereo.matcher import move_views as move_views
from depthpose.depth.stereo.network_matcher import NetworkMatcher as NetworkMatcher
from depthpose.depth.stereo.network_matcher import SearchRange as SearchRange
from depthpose.depth.stereo.network_matcher import StereoNetwork as StereoNetwork
from depthpose.depth.stereo.network_matcher import match_in_usual_range as match_in_usual_range
from depthpose.depth.stereo.network_matcher import normalise as normalise
from depthpose.depth.stereo.psmnet import PSMNet as PSMNet
from depthpose.depth.stereo.psmnet import PSMNetMatcher as PSMNetMatcher
from depthpose.depth.stereo.psmnet import import_psmnet as import_psmnet
from depthpose.depth.stereo.psmnet import psmnet_from_published as psmnet_from_published
from depthpose.depth.stereo.search_range import DisparityRange as DisparityRange
from depthpose.depth.stereo.search_range import choose_search_range as choose_search_range
from depthpose.depth.stereo.search_range import doubt_hidden as doubt_hidden
from depthpose.depth.stereo.search_range import doubt_outside as doubt_outside
from depthpose.depth.stereo.search_range import measure_disparity_range as measure_disparity_range
