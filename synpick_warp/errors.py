"""Exceptions for errors that a user can correct; the command line prints them as one line and exits with code 2."""

from __future__ import annotations


class SynpickError(Exception):
    """Base class; the message says in one line what was given, what is allowed and what to do."""


class ConfigError(SynpickError):
    """A setting is unknown, of the wrong type, out of range, or inconsistent with others."""


class CatalogError(SynpickError):
    """A model folder or one of its files cannot be used."""


class LightError(SynpickError):
    """A light map cannot be used."""


class DeviceError(SynpickError):
    """The requested device does not exist."""


class OutputError(SynpickError):
    """The output folder cannot be written."""


class DatasetError(SynpickError):
    """A folder is not a data set, or a file in it is missing or damaged."""


class ResultError(SynpickError):
    """A file of pose estimates cannot be used."""
