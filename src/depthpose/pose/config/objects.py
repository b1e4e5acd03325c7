"""Settings of synthetic views: how they look, and the errors of the sensor that sees them."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from depthpose.core.errors import InputError, refuse_seed

SensorKind = Literal["structured light", "active stereo", "time of flight", "laser", "none"]
"""What measures depth, and so what its errors look like."""
_LINEMOD_PX = (640, 480)
_LINEMOD_CENTRE_PX = (325.2611, 242.04899)
MOST_NOISE = 20.0
"""Times the noise of its kind that a sensor may have."""
OCCLUSIONS = (0.0, 0.95)
"""Least and largest share of a silhouette that something may occlude."""


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """The errors of a depth sensor. Ranges are of what each sample draws."""

    kinds: tuple[SensorKind, ...] = ("structured light",)
    """One of these measures each sample. ``structured light``: disparity in steps of 1/8 px, noise
    that grows with the squared distance (Nguyen et al. 2012), the projector's shadow. ``active
    stereo``: finer steps, edges displaced by the window that is matched, a shadow on the other
    side. ``time of flight``: mixed readings where depth jumps. ``laser``: little noise. ``none``:
    no error."""

    noise: tuple[float, float] = (0.5, 1.5)
    """Times the noise of the kind."""

    noise_correlation_px: tuple[float, float] | None = None
    """Correlation length of the noise (deviation of the Gaussian that smooths it), in pixels of the
    full image; None: 3 to 6 for ``active stereo``, else every pixel has its own. Measured on planes
    by ``bench/sensors.py``: a Kinect 3, a RealSense 5."""

    missing: tuple[float, float] = (0.0, 0.1)
    """Share of readings lost beside those of shadows and grazing surfaces; half in patches."""

    offset_m: tuple[float, float] = (-0.005, 0.005)
    """Added to all readings of a view alike: real sensors are off by 3 to 6 mm as a whole. Not of
    ``none``."""

    def __post_init__(self) -> None:
        """Refuse unknown kinds and empty ranges."""
        known = get_args(SensorKind)
        if not self.kinds or any(kind not in known for kind in self.kinds):
            raise InputError(f"kinds is {self.kinds}; name one or more of {', '.join(known)}")
        refuse_range("noise", self.noise, (0.0, MOST_NOISE), "(0.5, 1.5)")
        if self.noise_correlation_px is not None:
            refuse_range("noise_correlation_px", self.noise_correlation_px, (0.0, 30.0), "(3, 6)")
        refuse_range("missing", self.missing, (0.0, 0.9), "(0.0, 0.1)")
        refuse_range("offset_m", self.offset_m, (-0.1, 0.1), "(-0.005, 0.005), in metres")


@dataclass(frozen=True, kw_only=True)
class ObjectsConfig:
    """Synthetic views of known objects. Ranges are of what each sample draws."""

    INSTEAD: ClassVar[dict[str, str]] = {"image_px": "centre_px"}
    """A config file that gives another image has that one's middle, not the default's."""

    number: int = 1000
    """Samples; sample i shows object i modulo their number."""

    seed: int = 0
    """Another seed, other samples."""

    views: int | None = 2000
    """Renderings of each object, rendered at first use and then kept; a sample turns the camera of
    one of them at random, which shows the same surface. None: each sample is a rendering of its
    own, for evaluation."""

    distance_m: tuple[float, float] = (0.6, 1.1)
    """From the camera to the middle of the object."""

    image_px: tuple[int, int] = (640, 480)
    """Width and height of the sensor's image; the object lies somewhere in it."""

    focal_px: tuple[float, float] = (572.4114, 573.57043)
    """fx and fy; LineMOD's Kinect."""

    centre_px: tuple[float, float] | None = None
    """Principal point, within the image; None: the middle of the image, or that of LineMOD's Kinect
    in an image of 640x480. It is always known once the settings are made."""

    resolution: tuple[float, float] = (0.4, 0.8)
    """The image is so many times as large: coarser pictures are faster."""

    occluded_share: float = 0.7
    """Share of samples in which something occludes the object."""

    occlusion: tuple[float, float] = (0.0, 0.5)
    """Share of the silhouette that it occludes."""

    with_background: bool = True
    """Whether there is something behind and beside the object, which wrong masks take in."""

    mask_error_px: int = 3
    """The mask is grown or shrunk by up to so many pixels of the full image."""

    mask_shift_px: int = 2
    """And shifted by up to so many of them along each axis, as a predicted mask is."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    """What measures the depth."""

    frame_objects: tuple[int, int] = (2, 6)
    """Objects of a whole frame, no more than there are models."""

    frame_clutter: tuple[int, int] = (0, 4)
    """Boxes, balls and cans of no model among them."""

    def __post_init__(self) -> None:
        """Refuse counts of nothing, shares beyond one and empty ranges."""
        if self.number < 1 or (self.views is not None and self.views < 1):
            raise InputError(f"number is {self.number} and views {self.views}; both are 1 or more")
        refuse_seed(self.seed)
        if min(*self.image_px, *self.focal_px) <= 0:
            raise InputError(
                f"image_px is {self.image_px} and focal_px {self.focal_px}; both are positive "
                "pixels, as (640, 480) and (572.4114, 573.57043)"
            )
        self._place_centre()
        if not 0 <= self.occluded_share <= 1:
            raise InputError(f"occluded_share is {self.occluded_share}, but a share is 0 to 1")
        for name, usual in (("mask_error_px", 3), ("mask_shift_px", 2)):
            if not 0 <= getattr(self, name) <= 20:
                given = getattr(self, name)
                raise InputError(f"{name} is {given}; take 0 to 20, usually {usual}")
        for name in ("frame_objects", "frame_clutter"):
            low, high = getattr(self, name)
            least = 1 if name == "frame_objects" else 0
            if not least <= low <= high:
                raise InputError(
                    f"{name} is ({low}, {high}), but it goes from {least} or more upward; usual is "
                    f"({2 * least}, {4 + 2 * least})"
                )
        refuse_range("distance_m", self.distance_m, (0.05, 20.0), "(0.6, 1.1), in metres")
        refuse_range("resolution", self.resolution, (0.05, 4.0), "(0.4, 0.8)")
        refuse_range("occlusion", self.occlusion, OCCLUSIONS, "(0.0, 0.4)")

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """``centre_px``, or what it is where it was not given."""
        assert self.centre_px is not None
        return self.centre_px

    def _place_centre(self) -> None:
        width, height = self.image_px
        middle = ((width - 1) / 2, (height - 1) / 2)
        if self.centre_px is None:
            usual = _LINEMOD_CENTRE_PX if self.image_px == _LINEMOD_PX else middle
            object.__setattr__(self, "centre_px", usual)
        x, y = self.principal_point_px
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise InputError(
                f"centre_px is {(x, y)}, but the principal point lies within the image, and "
                f"image_px is {self.image_px}; leave it out for the middle, {middle}"
            )


def refuse_range(
    name: str, given: tuple[float, float], limits: tuple[float, float], usual: str
) -> None:
    """Refuse a range that is empty or reaches beyond its limits.

    Raises:
        InputError: that is so; ``usual`` is what one takes otherwise.
    """
    low, high = given
    if not limits[0] <= low <= high <= limits[1]:
        raise InputError(
            f"{name} is {given}, but it is a range within {limits[0]} to {limits[1]}, the lower "
            f"end first; usual is {usual}"
        )
