"""Depth from a rectified stereo camera."""

from depthpose_ros.launching import describe
from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Start the node with the parameters of a file."""
    return describe(
        executable="depth_pair",
        remappings=[
            (f"{side}/{topic}", f"/stereo/{side}/{topic}")
            for side in ("left", "right")
            for topic in ("image_rect", "camera_info")
        ],
    )
