"""Names that modules had before: importing one says where it is now."""

import sys

MOVED = {
    "cli.viewing": "report.viewer",
    "core.hold": "core.lock",
    "core.raster": "core.render",
    "core.report": "report.tables",
    "core.scene": "report.scene",
    "core.shipped": "core.hub",
    "depth.degrade": "depth.augment",
    "depth.figures": "thesis.depth_figures",
    "depth.floors": "depth.baselines",
    "depth.kitti": "depth.datasets",
    "depth.lite0": "depth.encoder",
    "depth.sizes": "depth.disparity",
    "depth.streets": "depth.synthetic",
    "depth.tables": "thesis.depth_tables",
    "demo.motorcycle": "demo.depth",
    "pages": "report",
    "pose.bop": "pose.datasets",
    "pose.figures": "thesis.pose_figures",
    "pose.objects": "pose.synthetic",
    "pose.overlay": "report.overlay",
    "pose.tables": "thesis.pose_tables",
}


class MovedFinder:
    """A finder of ``sys.meta_path``, asked last: for modules that no other has found.

    It does without ``importlib.abc``, which would double the time of ``import depthpose``.
    """

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        """Say the new name of a module of ours that moved.

        Raises:
            ModuleNotFoundError: it did.
        """
        del path, target
        package, _, name = fullname.partition(".")
        if package == "depthpose" and name in MOVED:
            raise ModuleNotFoundError(f"{fullname} is now depthpose.{MOVED[name]}", name=fullname)


def point_to_new_names() -> None:
    """Let imports of old names fail with the new one."""
    if not any(isinstance(finder, MovedFinder) for finder in sys.meta_path):
        sys.meta_path.append(MovedFinder())
