"""All errors that a user's input can cause.

A message says what was given, what was expected and what to do. The command line prints it without a traceback and exits
with status 2.
"""

from __future__ import annotations


class DroGraspError(Exception):
    """Base of all errors that dro-grasp raises on purpose."""


class HandError(DroGraspError):
    """A hand description cannot be used."""


class RobotError(DroGraspError):
    """The description of a robot, of arm and hand together, cannot be used."""


class PlanError(DroGraspError):
    """No motion of the robot grasps the object, or a plan file cannot be used."""


class ObjectError(DroGraspError):
    """A mesh or point cloud of an object cannot be used."""


class UngraspableError(ObjectError):
    """What was given is no thing for a hand to grasp, and may still be in its way: an image, a sheet, of another size."""

    def __init__(self, fault: str, advice: str = "") -> None:
        super().__init__(f"{fault}{advice}")
        self.fault = fault
        """What is wrong, without what to do for grasping it."""


class GraspFileError(DroGraspError):
    """A grasp file is truncated, foreign, or of another version."""


class WeightsError(DroGraspError):
    """A weights file is truncated, foreign, or of another version."""


class BundleError(DroGraspError):
    """A training bundle is truncated, foreign, or incomplete for training."""


class OptionError(DroGraspError):
    """An option or argument has an invalid value."""


class NoGraspError(OptionError):
    """No grasp meets what was asked for; the message says why, and what to change."""


class OutputError(DroGraspError):
    """A path cannot be written."""


class TrainingError(DroGraspError):
    """Training cannot continue, for example after a non-finite loss."""


class ClusterError(DroGraspError):
    """A cluster of machines on which work is done is gone."""


class ServerError(DroGraspError):
    """A grasp server refuses a request, fails, or is not there."""

    def __init__(self, message: str, retry_after: float | None = None, status: int | None = None) -> None:
        super().__init__(message)
        self.retry_after = retry_after
        """When it is worth while to ask again [s]; None where that is not known."""
        self.status = status
        """The status of HTTP that it answered with; None where it did not answer."""
