"""What the launch files share: a node with the parameters of a file."""

from collections.abc import Sequence
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def describe(executable: str, remappings: Sequence[tuple[str, str]]) -> LaunchDescription:
    """Start a node of this package; ``params:=FILE`` takes other parameters than its own.

    Args:
        executable: of the node, and its name.
        remappings: names of its topics, and those of the camera's driver.
    """
    share = Path(get_package_share_directory("depthpose_ros"))
    default = str(share / "config" / "depthpose.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=default, description="parameters, YAML"),
            Node(
                package="depthpose_ros",
                executable=executable,
                name=executable,
                namespace="depthpose",
                parameters=[LaunchConfiguration("params")],
                remappings=remappings,
            ),
        ]
    )
