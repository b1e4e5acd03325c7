"""What colcon builds the package by (ament_python)."""

from pathlib import Path

from setuptools import setup

NAME = "depthpose_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", [str(path) for path in Path("launch").glob("*.launch.py")]),
        (f"share/{NAME}/config", ["config/depthpose.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The depthpose authors",
    maintainer_email="depthpose@example.org",
    description="ROS 2 nodes of depthpose: metric depth, and 6-DoF poses of known objects.",
    license="MIT",
    entry_points={
        "console_scripts": [
            f"depth_image = {NAME}.nodes:depth_image",
            f"depth_pair = {NAME}.nodes:depth_pair",
            f"poses = {NAME}.nodes:poses",
        ]
    },
)
