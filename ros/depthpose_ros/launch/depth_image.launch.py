"""Depth from one rectified camera."""

from depthpose_ros.launching import describe
from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Start the node with the parameters of a file."""
    return describe(
        executable="depth_image",
        remappings=[
            ("image_rect", "/camera/image_rect"),
            ("camera_info", "/camera/camera_info"),
        ],
    )
