"""Inner loops of a pose, compiled by numba where the extra ``fast`` is installed.

Each gives what the torch code beside it gives, to rounding, in a small part of the time: clouds
have hundreds of points, and most of torch's time is the overhead of its calls. The first call of
each function compiles it; what was compiled is kept on disk until a source changes.
"""

from depthpose.pose.compiled.choice import GRAZING as GRAZING
from depthpose.pose.compiled.choice import LOOKED_UP as LOOKED_UP
from depthpose.pose.compiled.choice import ON_RAY as ON_RAY
from depthpose.pose.compiled.choice import SEARCHED as SEARCHED
from depthpose.pose.compiled.choice import SLACK as SLACK
from depthpose.pose.compiled.choice import is_compiled as is_compiled
from depthpose.pose.compiled.choice import serves as serves
