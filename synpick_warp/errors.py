"""Errors that a user can cause and mend. The command line prints them as one line and exits with code 2."""

from __future__ import annotations


class SynpickError(Exception):
    """What came, what is allowed, and what to do about it, in one line."""


class ConfigError(SynpickError):
    """A setting is unknown, of the wrong type, or out of range."""


class CatalogError(SynpickError):
    """A model folder or one of its files cannot be used."""


class LightError(SynpickError):
    """A light map cannot be used."""


class DeviceError(SynpickError):
    """The device that was asked for is not there."""


class OutputError(SynpickError):
    """The output folder cannot be written."""


class DatasetError(SynpickError):
    """A folder is no data set, or lacks a file that it should have."""
