"""Poses of known objects in the images of a depth sensor."""

from depthpose_ros.launching import describe
from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Start the node with the parameters of a file."""
    return describe(
        executable="poses",
        remappings=[
            ("depth", "/camera/depth/image_rect"),
            ("camera_info", "/camera/depth/camera_info"),
            ("mask", "/camera/mask"),
        ],
    )
