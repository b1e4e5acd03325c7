"""Depth from one rectified camera."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Start the node with the parameters of a file."""
    share = Path(get_package_share_directory("depthpose_ros"))
    default = str(share / "config" / "depthpose.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=default, description="parameters, YAML"),
            Node(
                package="depthpose_ros",
                executable="depth_image",
                name="depth_image",
                namespace="depthpose",
                parameters=[LaunchConfiguration("params")],
                remappings=[
                    ("image_rect", "/camera/image_rect"),
                    ("camera_info", "/camera/camera_info"),
                ],
            ),
        ]
    )
