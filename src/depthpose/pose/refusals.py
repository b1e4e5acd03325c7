"""Why an input has no pose: its data do not allow one, or it cannot be taken at all."""

from collections.abc import Callable
from typing import Any, TypeVar

from depthpose.core.devices import refused_memory
from depthpose.core.errors import InputError
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose.types import AnyInput, PoseEstimate, Status

Result = TypeVar("Result")


class Refused(Exception):  # noqa: N818  an answer, and no error of the caller's
    """The data do not allow a pose; raised where they lack something.

    Args:
        status: the kind of refusal.
        reason: one sentence for people.
        measured: fields of the estimate that are known without its pose, such as ``evidence``.
    """

    def __init__(self, status: Status, reason: str, **measured: Any) -> None:  # noqa: ANN401
        super().__init__(reason)
        self.status: Status = status
        self.reason = reason
        self.measured = measured


def estimate_or_refusal(
    pose_input: AnyInput, watch: Stopwatch, work: Callable[[], Result]
) -> Result | PoseEstimate:
    """Do work on an input; where it is :class:`Refused`, return the estimate that says so.

    Args:
        pose_input: the input.
        watch: of the stages of the work, whose times the estimate has.
        work: what is done.
    """
    try:
        return work()
    except Refused as refused:
        return PoseEstimate(
            name=pose_input.name,
            object=pose_input.object,
            status=refused.status,
            reason=refused.reason,
            seconds=watch.seconds,
            **refused.measured,
        )


def unreadable_on_error(pose_input: AnyInput, work: Callable[[], Result]) -> Result | PoseEstimate:
    """Do work on an input; where it cannot be taken at all, return the estimate that says so."""
    try:
        with refused_memory(pose_input.name):
            return work()
    except InputError as error:
        return PoseEstimate(
            name=pose_input.name,
            object=pose_input.object,
            status="unreadable",
            reason=str(error),
        )
