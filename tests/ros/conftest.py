import sys
from pathlib import Path

# The package lies beside the library and is installed by colcon alone.
sys.path.insert(0, str(Path(__file__).parents[2] / "ros" / "depthpose_ros"))
