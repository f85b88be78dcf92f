"""Untrusted input: bounded reads of files, path containment, JSON and TOML decoding with limits.

Every file that did not come with the program is read through this room: settings, models, light maps, and data sets, which may have been
edited, damaged, or made by somebody else.
"""
