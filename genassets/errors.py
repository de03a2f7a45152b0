"""The errors that reach a person: one complete paragraph each, and the exit code the command ends with."""

from __future__ import annotations


class GenAssetsError(Exception):
    """Base of every error with a message written for the user.

    `str(error)` is the complete message: what is wrong, where (file, row, field), what was
    expected, what to do.
    `exit_code` is what the `genassets` command ends with.
    """

    exit_code: int = 1


class SpecError(GenAssetsError):
    """A spec in data_specs/ or a command-line option is wrong."""

    exit_code = 2


class StageError(GenAssetsError):
    """A stage of an experiment failed."""

    exit_code = 3


class DamagedFile(StageError):
    """A file that an earlier stage or run wrote is no longer whole."""


class CodeChanged(StageError):
    """The source was edited while a run was going, so what it makes would be of no one version."""


class LogError(GenAssetsError):
    """A driving log is missing, incomplete or malformed."""

    exit_code = 3


class DatasetError(GenAssetsError):
    """A detector set cannot be written, or one on disk is missing, incomplete or malformed."""

    exit_code = 3


class LockedError(GenAssetsError):
    """Another process holds the lock of the object this one wants to write."""

    exit_code = 5


class EnvironmentProblem(GenAssetsError):
    """Something the machine has to provide is missing: a package, a system library, disk space, a setting."""

    exit_code = 6


class WeightsError(EnvironmentProblem):
    """A pretrained file is missing, or its bytes are not the pinned ones."""
