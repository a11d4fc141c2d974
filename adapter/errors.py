"""What can be wrong with a model, said in one sentence."""

from __future__ import annotations


class ModelError(ValueError):
    """A model cannot be read, built, saved or exported; the message says why and what would do."""


class ModelWarning(UserWarning):
    """A model was read, but not everything in its file was taken at its word."""


class ControlError(RuntimeError):
    """The controller cannot keep the arm; it has to be stopped by its driver."""


class UsageError(ValueError):
    """The command line asks for something that does not exist; the message names the choices."""


class MeansError(RuntimeError):
    """The machine lacks what is needed: memory that processes share, a process, an estimate."""


class SettingsError(ValueError):
    """A setting has a value or a name that does not fit; the message says what does."""
