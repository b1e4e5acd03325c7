"""The bound on memory, measured from outside."""

import subprocess
import sys

import pytest

_MEASURE = """
import resource, sys, torch
from depthpose.depth.config import MatcherConfig
from depthpose.depth.stereo import PSMNet, PSMNetMatcher
torch.manual_seed(0)
matcher = PSMNetMatcher(PSMNet().eval(), MatcherConfig(max_memory_bytes=1_000_000_000))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
matcher.match(torch.rand(3, 375, 1242), torch.rand(3, 375, 1242))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


@pytest.mark.slow
def test_a_full_frame_stays_below_a_bound_of_one_gigabyte() -> None:
    answer = subprocess.run([sys.executable, "-c", _MEASURE], capture_output=True, check=True)
    assert int(answer.stdout) < 1_000_000_000
