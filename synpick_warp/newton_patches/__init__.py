"""Replacements of private parts of Newton, until they are in Newton: solver iterations, broad phase, launch sizes, compilation."""

KNOWN_NEWTON = "1.8.0"
"""Version of Newton that the replacements fit. Others are used as they are, slower; README.md says what to do when Newton moves."""
