"""Every error that a user's input can cause.

Messages say what was given, what was expected, and what to do. The command line prints them without a
traceback and exits with status 2.
"""

from __future__ import annotations


class DroGraspError(Exception):
    """Root of all errors that dro-grasp raises on purpose."""


class HandError(DroGraspError):
    """A hand description cannot be used."""


class ObjectError(DroGraspError):
    """An object's mesh or point cloud cannot be used."""


class GraspFileError(DroGraspError):
    """A grasp file is truncated, foreign, or of another version."""


class WeightsError(DroGraspError):
    """A weights file is truncated, foreign, or of another version."""


class BundleError(DroGraspError):
    """A training bundle is truncated, foreign, or lacks what training needs."""


class OptionError(DroGraspError):
    """An option or argument has a value outside its range."""


class OutputError(DroGraspError):
    """A path cannot be written."""


class TrainingError(DroGraspError):
    """Training cannot go on, for example after a non-finite loss."""
